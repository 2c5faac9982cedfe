"""Which topics of a bag are the odometry, the echoes and the truth."""

from collections.abc import Iterable

from pipistrelle.config import BagConfig
from pipistrelle.detection.logs.bag import Bag, Topic
from pipistrelle.detection.logs.bag_frames import TRANSFORMS, TRANSFORMS_TYPE
from pipistrelle.detection.logs.bag_messages import ECHOES, ODOMETRY, POSES
from pipistrelle.refusals import refusal


def odometry_of(bag: Bag, settings: BagConfig) -> str:
    """Return the topic of the odometry: the one that is named, or the only one."""
    if settings.odometry is not None:
        return bag.checked(settings.odometry, [ODOMETRY], "--bag.odometry")
    there = _odometries(bag.topics.values(), settings)
    if len(there) == 1:
        return there[0]
    found = f"several topics of odometry: {', '.join(there)}" if there else "no odometry"
    fix = "name one: --bag.odometry TOPIC" if there else "--topics lists what there is"
    raise refusal(bag.path, found, f"one topic of {ODOMETRY}", fix)


def echoes_of(bag: Bag, settings: BagConfig) -> list[str]:
    """Return the topics of the echoes: those that are named, or all of a known type."""
    if settings.echoes:
        names = dict.fromkeys(settings.echoes)
        return [bag.checked(name, ECHOES, "--bag.echoes") for name in names]
    names = [topic.name for topic in bag.topics.values() if topic.type in ECHOES]
    if not names:
        expected = f"a topic of {', '.join(ECHOES)}"
        raise refusal(bag.path, "no echoes", expected, "--topics lists what there is")
    return names


def transforms_of(bag: Bag) -> list[str]:
    """Return the topic of the static transforms, if the bag has it."""
    there = bag.topics.get(TRANSFORMS)
    if there is not None and there.type != TRANSFORMS_TYPE:
        where, fix = f"{bag.path}, topic {TRANSFORMS}", "leave the topic out of the bag"
        raise refusal(where, f"the type {there.type}", TRANSFORMS_TYPE, fix)
    return [] if there is None else [TRANSFORMS]


def truth_of(bag: Bag, settings: BagConfig) -> str | None:
    """Return the topic of the truth, if one is named."""
    return None if settings.truth is None else bag.checked(settings.truth, POSES, "--truth")


def roles(topics: Iterable[Topic], settings: BagConfig) -> dict[str, str]:
    """Say what each topic would be taken for; empty where for nothing.

    >>> odometry = Topic(name="/odom", type=ODOMETRY, count=3)
    >>> roles([odometry], BagConfig()), roles([odometry], BagConfig(truth="/odom"))
    ({'/odom': 'odometry'}, {'/odom': 'truth'})
    """
    topics = list(topics)
    odometries = [settings.odometry] if settings.odometry else _odometries(topics, settings)
    echoes = settings.echoes or [topic.name for topic in topics if topic.type in ECHOES]

    def role(topic: Topic) -> str:
        if topic.name == settings.truth:
            return "truth"
        if topic.name in odometries:
            return "odometry" if len(odometries) == 1 else "odometry, if --bag.odometry names it"
        if topic.name in echoes:
            return "echoes"
        if topic.name == TRANSFORMS:
            return "transforms"
        return "truth, if --truth names it" if topic.type in POSES else ""

    return {topic.name: role(topic) for topic in topics}


def _odometries(topics: Iterable[Topic], settings: BagConfig) -> list[str]:
    """List the topics that may be the odometry."""
    return [one.name for one in topics if one.type == ODOMETRY and one.name != settings.truth]
