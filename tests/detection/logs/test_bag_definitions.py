"""Definitions of messages in bags: read as rosbags reads them, and no text of them takes a machine.

The texts that attack are made up here; the sound ones are written by rosbags.
"""

import tracemalloc

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipistrelle.config import BagConfig, InputError
from pipistrelle.detection.logs.bag_messages import (
    DEEPEST,
    DEFINITIONS,
    ECHOES,
    LONGEST,
    MOST_PARTS,
    POSES,
    read_definition,
    types_of,
)
from pipistrelle.experiments.runs.replay import load
from reference.bags import (
    DETECTIONS,
    LABELLED,
    ODOMETRY,
    RANGE,
    TRANSFORMS,
    header,
    labelled,
    made,
    odometry,
    store_of,
    write_bag,
)

OURS = (*POSES, *ECHOES, TRANSFORMS)
LINE = "=" * 80 + "\n"
PART = LINE + "MSG: a_msgs/{}\n"


def sound(name, store=None, version=2):
    """Return the text by which rosbags defines a type."""
    return (store or store_of()).generate_msgdef(name, ros_version=version)[0]


def drive():
    """Tell a drive past a post."""
    rows = [("/odom", ODOMETRY, 0.1 * i, odometry(0.1 * i, 0.1 * i, 0.0, 0.0)) for i in range(5)]
    return [*rows, ("/seen", LABELLED, 0.4, labelled(0.4, [(7, 0.5, 3.0)]))]


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("version", [1, 2])
def test_a_text_that_rosbags_writes_is_the_known_definition(name, version):
    store = store_of(first=version == 1)
    text = sound(name, store, version)
    plain = {one: fields for one, (_, fields) in get_types_from_msg(text, name).items()}
    assert read_definition(name, text) == plain
    kinds = types_of(name, text, idl=False, first=version == 1)
    assert kinds is types_of(name, "", idl=False, first=version == 1)
    assert kinds.fielddefs[name] == store.fielddefs[name]


def test_comments_constants_and_defaults_are_passed_over():
    lines = (
        "# int8 no\n\nuint8 SOUND = 0  # =\nstring WORD='int8 x'\n  uint8 radiation_type 1 #\r\n"
    )
    text = sound(RANGE).replace("uint8 radiation_type\n", lines)
    assert read_definition(RANGE, text) == read_definition(RANGE, sound(RANGE))


def test_a_range_of_a_later_ros_has_its_variance():
    later = get_typestore(Stores.LATEST)
    kinds = types_of(RANGE, sound(RANGE, later), idl=False, first=False)
    assert kinds.fielddefs[RANGE][1] == later.fielddefs[RANGE][1]
    assert "variance" in dict(kinds.fielddefs[RANGE][1])


IDL = """// generated from rosidl_adapter/resource/msg.idl.em
#include "std_msgs/msg/Header.idl"
module sensor_msgs {
  module msg {
    module Range_Constants {
      @verbatim (language="comment", text="a * b, (c) << 4; }" "\\" } struct")
      const uint8 ULTRASOUND = 0;
    };
    /* struct Range { } */
    struct Range {
      std_msgs::msg::Header header;
      @verbatim (language="comment", text="the type")
      uint8 radiation_type;
      @unit (value="rad")
      float field_of_view; float min_range; float max_range;
      float range;
    };
  };
};
"""


def test_a_bag_that_is_defined_in_idl_is_read(tmp_path):
    ping = {"header": header(0.2, "base_link"), "range": 2.0, "max_range": 6.0}
    told = sorted([*drive(), ("/front", RANGE, 0.2, ping)], key=lambda one: one[2])
    text = f"{LINE}IDL: sensor_msgs/msg/Range\n{IDL}"
    path = write_bag(tmp_path / "one.mcap", told, definitions={"/front": text})
    log, _ = load(path, bag=BagConfig(step=0.0, echoes=("/front",)))
    assert log.scans[0].range == pytest.approx([2.0])


def test_arrays_and_sequences_of_idl_match_ros_definitions():
    text = """module a_msgs { module msg { typedef double double__3[3];
      struct In { string<5> s; sequence<float, 4> f; unsigned long long u; };
      struct Out { double__3 d; a_msgs::msg::In one; sequence<In> many; long n; octet b; }; }; };"""
    plain = "float64[3] d\nIn one\nIn[] many\nint32 n\nbyte b\n" + PART.format("In")
    plain += "string s\nfloat32[] f\nuint64 u\n"
    name = "a_msgs/msg/Out"
    assert read_definition(name, text, idl=True) == read_definition(name, plain)


@pytest.mark.parametrize("more", ["string[2] notes\n", "Extra[3] extra\n", "int8[1000000] far\n"])
def test_extra_fields_are_decoded_by_the_recorded_definition(more):
    text = more + sound(ODOMETRY) + PART.replace("a_msgs", "nav_msgs").format("Extra") + "int8 x\n"
    types = get_types_from_msg(text, ODOMETRY)
    theirs = get_typestore(Stores.EMPTY)
    theirs.register({name: kind for name, kind in types.items() if name not in theirs.types})
    message = made(theirs, ODOMETRY, odometry(0.5, 1.0, -2.0, 0.0))
    if "notes" in more:
        message.notes = ["a", "bc"]
    elif "Extra" in more:
        message.extra = [theirs.types["nav_msgs/msg/Extra"](x=i) for i in range(3)]
    data = bytes(theirs.serialize_cdr(message, ODOMETRY))
    kinds = types_of(ODOMETRY, text, idl=False, first=False)
    found = kinds.deserialize_cdr(data, ODOMETRY)
    assert (found.pose.pose.position.x, found.pose.pose.position.y) == (1.0, -2.0)
    assert found.child_frame_id == "base_link"


def test_each_definition_of_a_topic_decodes_its_messages(tmp_path):
    store, text = store_of(first=True), "int32 more\n" + sound(ODOMETRY, store_of(first=True), 1)
    theirs = get_typestore(Stores.EMPTY)
    theirs.register(get_types_from_msg(text, ODOMETRY))
    with Writer(tmp_path / "one.bag") as writer:
        plain = writer.add_connection("/odom", ODOMETRY, typestore=store, callerid="/a")
        more = {"msgdef": text, "md5sum": "0" * 32, "callerid": "/b"}
        other = writer.add_connection("/odom", ODOMETRY, **more)
        seen = writer.add_connection("/seen", LABELLED, typestore=store)
        for i in range(6):
            kinds, topic = (store, plain) if i % 2 else (theirs, other)
            content = made(kinds, ODOMETRY, odometry(0.1 * i, 0.1 * i, 0.0, 0.0))
            writer.write(topic, 10**8 * i, kinds.serialize_ros1(content, ODOMETRY))
        content = made(store, LABELLED, labelled(0.5, [(7, 0.5, 3.0)]))
        writer.write(seen, 10**9, store.serialize_ros1(content, LABELLED))
    log, _ = load(tmp_path / "one.bag", bag=BagConfig(step=0.0))
    np.testing.assert_allclose(log.controls[:, 0], 0.1)


def chain(length, width=1):
    """Define records within one another."""
    parts = (f"{PART.format(f'R{i}')}" + f"R{i + 1} a{{}}\n" * width for i in range(length))
    fields = "".join(part.format(*range(width)) for part in parts)
    return f"a_msgs/R0 more\n{sound(ODOMETRY)}{fields}{PART.format(f'R{length}')}int8 x\n"


def idl(body):
    """Define Odometry in IDL."""
    return f"{LINE}IDL: {ODOMETRY}\nmodule nav_msgs {{ module msg {{ {body} }}; }};"


HOSTILE = {
    "unrolled texts": ("string[20000000] x\n", "header as nothing"),
    "unrolled texts beside": ("string[20000000] x\n" + sound(ODOMETRY), "fields and elements"),
    "unrolled records": (
        f"a_msgs/Y[5000000] x\n{sound(ODOMETRY)}{PART.format('Y')}int8 y\n",
        "fields and elements",
    ),
    "nested arrays": (
        f"a_msgs/Y[40] x\n{sound(ODOMETRY)}{PART.format('Y')}Z[40] z\n{PART.format('Z')}int8 y\n",
        "fields and elements",
    ),
    "a known field unrolled": (
        sound(ODOMETRY).replace("float64[36] covariance", "float64[99999999] covariance"),
        r"covariance as float64[99999999], expected float64[36]",
    ),
    "another type": (
        sound(ODOMETRY).replace("string child_frame_id", "float64 child_frame_id"),
        "child_frame_id as float64, expected string",
    ),
    "recursion": (
        f"a_msgs/Y x\n{sound(ODOMETRY)}{PART.format('Y')}Y[] y\n",
        "a_msgs/msg/Y within itself",
    ),
    "recursion of the root": (f"Odometry x\n{sound(ODOMETRY)}", f"{ODOMETRY} within itself"),
    "a deep chain": (chain(500), f"more than {DEEPEST} records"),
    "a wide chain": (chain(15, 200), "fields and elements"),
    "no definition": (f"a_msgs/Y x\n{sound(ODOMETRY)}", "no definition of a_msgs/msg/Y"),
    "a long text": ("#" * (LONGEST + 1), "characters"),
    "many lines": ("\n" * (LONGEST - 40) + "int8 x\n", "header as nothing"),
    "many fields": (sound(ODOMETRY) + PART.format("Y") + "int8 x\n" * 20000, "a field twice"),
    "a field twice": (f"int8 x\nint8 x\n{sound(ODOMETRY)}", "a field twice"),
    "a type twice": (
        f"{sound(ODOMETRY)}{LINE}MSG: std_msgs/Header\nint8 x\n",
        "two definitions in std_msgs/msg/Header",
    ),
    "an odd field": (sound(ODOMETRY).replace("header", "__class__"), "__class__"),
    "an odd type": (f"a_msgs/../Y x\n{sound(ODOMETRY)}", "a_msgs/../Y"),
    "an odd part": (f"{sound(ODOMETRY)}{LINE}MSG: a'b/c\nint8 x\n", "a'b/c"),
    "a number of digits": (f"int8[{'9' * 5000}] x\n{sound(ODOMETRY)}", "expected a type"),
    "an odd letter": (f"int8 \u0435x\n{sound(ODOMETRY)}", "expected a type"),
    "arithmetic": (idl("struct Odometry { double x[1 << 4000000000]; };"), "'<' in IDL"),
    "powers": (
        idl("const long A = 9999 * 9999; struct Odometry { double x[A * A]; };"),
        "'A' in IDL",
    ),
    "constants": (idl("const long A = 1 << 4000000000; struct Odometry { double x[A]; };"), "'A'"),
    "a union": (idl("union Odometry switch (long) { };"), "'union' in IDL"),
    "deep modules": (idl("module a { " * 9000), "'module' in IDL"),
    "deep lists": (idl(f"struct Odometry {{ {'sequence<' * 9000} double"), "arrays of arrays"),
    "an open text": (idl('struct Odometry { @a (b="' + '\\"' * 50000), "the name of a type"),
    "an open remark": (idl("/*" * 50000), "IDL"),
    "an unrolled list": (
        idl("struct Odometry { string x[20000000]; };"),
        "header as nothing, expected std_msgs/msg/Header",
    ),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_definition_that_would_take_the_machine_is_refused_in_words(tmp_path, kind):
    text, part = HOSTILE[kind]
    path = write_bag(tmp_path / "one.mcap", drive(), definitions={"/odom": text})
    types_of(ODOMETRY, sound(ODOMETRY), idl=False, first=False)  # the known ones are in memory
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as error:
            load(path)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
    words = str(error.value)
    assert f"{path}, topic /odom: " in words
    assert part in words
    assert "expected" in words
    assert len(words) < 600


def test_as_many_fields_as_are_allowed_are_decoded():
    text = f"string[{MOST_PARTS - 100}] x\n" + sound(ODOMETRY)
    assert types_of(ODOMETRY, text, idl=False, first=False).fielddefs[ODOMETRY]


def test_a_topic_of_transforms_of_another_type_is_refused(tmp_path):
    told = [("/tf_static", "std_msgs/msg/Empty", 0.0, {}), *drive()]
    path = write_bag(tmp_path / "one.mcap", told)
    with pytest.raises(InputError, match=r"topic /tf_static.*std_msgs/msg/Empty"):
        load(path)


def test_definitions_are_parsed_like_rosbags():
    for name in (DETECTIONS, LABELLED):
        assert read_definition(name, DEFINITIONS[name])[name] == store_of().fielddefs[name][1]
