"""What is in a ROS bag, as a table: `pipistrelle slam BAG --topics`."""

from pathlib import Path

from pipistrelle.detection.logs.readers import ROS_BAG
from pipistrelle.refusals import refusal
from pipistrelle.settings import Layer, resolve
from pipistrelle.verbs.streams import put
from pipistrelle.verbs.text_tables import text_table

HEADS = ("topic", "type", "messages", "from [s]", "to [s]", "rate [Hz]", "taken for")


def list_topics(path: Path, layer: Layer) -> int:
    """Print the topics of a bag, and what each is taken for; times are those of reception."""
    from pipistrelle.detection.logs.bag import Topic, opened
    from pipistrelle.detection.logs.bag_log import roles

    settings = resolve(layer).bag
    if not ROS_BAG.recognises(path):
        fix = "leave out --topics"
        raise refusal(f"{path}, option --topics", "no ROS bag by its name", "one", fix)
    with opened(path) as bag:
        topics = bag.seen()
    taken = roles(topics, settings)

    def row(topic: Topic) -> list[str]:
        first, last = topic.span if topic.span and topic.count else (0.0, 0.0)
        rate = f"{(topic.count - 1) / (last - first):.4g}" if last > first else ""
        span = [f"{first:.3f}", f"{last:.3f}"] if topic.count else ["", ""]
        words = topic.name, topic.type, str(topic.count), *span, rate, taken[topic.name]
        return [repr(word)[1:-1] for word in words]

    put(text_table("", [HEADS], [row(topic) for topic in topics]))
    return 0
