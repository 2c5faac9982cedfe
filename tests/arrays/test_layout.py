"""Arrays: faces of a square, and microphones read from files and written to them."""

import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.arrays.layout import (
    MAX_BYTES,
    Microphones,
    array_text,
    read_array,
    square_of_four,
    write_array,
)
from pipistrelle.config import Config, InputError, ReceiverConfig

LAYOUT = square_of_four(ReceiverConfig())


def test_ten_centred_elements_are_spaced_by_half_the_vehicles_wavelength():
    config = Config()
    half = config.air.sound_speed / config.emitter.frequency / 2.0
    np.testing.assert_allclose(np.diff(LAYOUT.position), [half] * 9, rtol=1e-12)
    assert LAYOUT.position.sum() == pytest.approx(0.0, abs=1e-15)


def test_every_direction_is_within_75_degrees_of_one_or_two_faces():
    bearing = np.radians(np.arange(-180.0, 180.0, 0.5))
    off = np.abs(np.angle(np.exp(1j * (bearing[:, None] - LAYOUT.normal))))
    faces = np.sum(off <= np.radians(75.0), axis=1)
    assert set(faces) == {1, 2}
    assert np.mean(faces == 2) == pytest.approx(60.0 / 90.0, abs=0.01)  # 15 to 75 degrees


PAIR = "channel,x,y\n1,0,0\n2,0,0.1\n"
REFUSED = {
    "": ("no rows", "channel,x,y"),
    "channel,x,y\n1,0,0\n": ("1 microphone", "2 to 256"),
    "channel,x,y,gain_db\n1,0,0,0\n2,0,1,1e5\n": ("line 3", "gain_db", "100 dB"),
    "channel,x,y,face\n1,0,0,a b\n2,0,1,\n": ("line 2", "face 'a b'"),
    "channel,x,y\n-1,0,0\n2,0,1\n": ("line 2", "channel -1"),
    "channel,x,y\n1,0,0\n1,0,1\n": ("line 3", "channel 1 again", "line 2"),
    "channel,x,y\n1,0,0\n3,0,1\n": ("line 3", "channel 3 after 1"),
    "channel,x,y\n2,0,0\n3,0,1\n": ("line 2", "0 or 1"),
    "channel,x,y\n1,0.2,0\n\n2,0.2,0\n": ("line 4", "channel 1 is (line 2)", "x, y, z"),
    "channel,x,y\n1,0,0\n2,0,44.1\n": ("44.1 m wide", "millimetres"),
    "<MicArray><pos x='0' y='0' z='0'/></MicArray>": ("1 microphone",),
    "<MicArray>\n<pos x='0' y='0'/></MicArray>": ("line 2", "x, y and z"),
    "<MicArray>\n<pos x='0' y='a' z='0'/></MicArray>": ("line 2", "y 'a'"),
    "<MicArray>\n<pos": ("line 2", "Acoular"),
    "<html></html>": ("without microphones",),
    "<!DOCTYPE a [<!ENTITY b 'c'>]>\n<MicArray/>": ("line 1", "document type"),
}


@pytest.mark.parametrize("text", REFUSED, ids=range(len(REFUSED)))
def test_an_invalid_array_file_is_refused_with_file_and_line(tmp_path, text):
    path = tmp_path / "array.csv"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        read_array(path)
    words = str(refused.value)
    assert words.startswith(str(path))
    assert all(word in words for word in REFUSED[text])


def test_a_folder_a_pipe_a_link_to_nothing_and_a_huge_file_are_not_read(tmp_path):
    pipe, link, huge = tmp_path / "pipe", tmp_path / "link", tmp_path / "huge.csv"
    os.mkfifo(pipe)
    link.symlink_to("nowhere")
    huge.write_text(PAIR + "#" * MAX_BYTES)
    for path, word in {tmp_path: "folder", pipe: "pipe", link: "link", huge: "1.0 MB"}.items():
        with pytest.raises(InputError, match=word):
            read_array(path)


def test_rows_are_sorted_by_channel_and_empty_cells_take_defaults(tmp_path):
    path = tmp_path / "array.csv"
    path.write_text("# ours\nchannel,x,y,gain_db,face\n1,0.1,0.2,,\n\n0,0.3,0.4,-3,left\n")
    found = read_array(path)
    assert found.channel.tolist() == [0, 1]
    assert found.position.tolist() == [[0.3, 0.4, 0.0], [0.1, 0.2, 0.0]]
    assert found.gain_db.tolist() == [-3.0, 0.0]
    assert found.face == ("left", "")


XML = (
    '<?xml version="1.0" encoding="{}"?>\n<MicArray name="{}">\n'
    '<pos Name="a" x="0.0" y="-0.02" z="0.1"/>\n<pos Name="b" x="0" y="0.02" z="0.1"/>\n</MicArray>'
)


@pytest.mark.parametrize(
    ("encoding", "name"),
    [
        ("utf-8", "耳"), ("UTF-8", "é"), ("utf-8-sig", "é"), ("us-ascii", "pair"),
        ("shift_jis", "耳のソ"), ("cp932", "髙①"), ("euc-jp", "耳"), ("iso-2022-jp", "耳"),
        ("gbk", "麦克风"), ("GB2312", "麦"), ("gb18030", "麦"), ("big5", "麥"),
        ("euc-kr", "마이크"), ("shift_jis", "髙①"), ("gb2312", "镕"),
        ("iso-8859-1", "é"), ("windows-1252", "€"), ("koi8-r", "ж"),
        ("utf-16", "耳"), ("UTF-16LE", "耳"), ("UTF-16BE", "耳"), ("utf-32", "耳"), ("utf-7", "耳"),
    ],
)  # fmt: skip
def test_xml_is_read_in_the_encoding_that_it_declares(tmp_path, encoding, name):
    xml, plain = tmp_path / "array.csv", tmp_path / "plain.xml"
    on_windows = {"shift_jis": "cp932", "gb2312": "gb18030"}.get(encoding, encoding)
    xml.write_bytes(XML.format(encoding, name).encode(on_windows))
    plain.write_text(XML.format("utf-8", "pair"))
    assert array_text(read_array(xml)) == array_text(read_array(plain))


@pytest.mark.parametrize(
    "encoding",
    [
        "foo", "hex", "rot13", "idna", "punycode", "undefined", "base64", "zlib", "mbcs", "",
        "unicode_escape", "raw_unicode_escape", "../x", "utf-8\0", "x" * 100_000, "utf-16",
        "UTF-32", "utf_8; y", "é", "os.system",
    ],
)  # fmt: skip
def test_xml_in_an_encoding_that_is_none_is_refused(tmp_path, encoding):
    xml = tmp_path / "array.xml"
    xml.write_bytes(XML.format(encoding, "pair").encode())
    with pytest.raises(InputError, match=r"array\.xml: found XML .*; save it as UTF-8"):
        read_array(xml)


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("utf-8", XML.format("utf-8", "耳").encode("shift_jis")),
        ("gbk", XML.format("gbk", "").encode() + b"\xff"),
        ("us-ascii", XML.format("us-ascii", "é").encode()),
        ("utf-7", XML.format("utf-7", "+2AA-").encode()),
        ("utf-8", XML.format("utf-8", "").encode().replace(b"pair", b"\xed\xa0\x80") + b"\xff"),
    ],
)
def test_xml_in_another_encoding_than_it_declares_is_refused(tmp_path, encoding, data):
    (tmp_path / "array.xml").write_bytes(data)
    with pytest.raises(InputError, match=f"found XML whose bytes are no {encoding}"):
        read_array(tmp_path / "array.xml")


@pytest.mark.parametrize("data", [b"\xff\xfe", b"\xff\xfec\0h\0", b"\0<\0?", b"<", b"<?xml", b""])
def test_a_file_that_is_neither_xml_nor_table_is_refused(tmp_path, data):
    (tmp_path / "array.xml").write_bytes(data)
    with pytest.raises(InputError, match=r"array\.xml"):
        read_array(tmp_path / "array.xml")


def test_acoulars_xml_is_the_same_array_as_its_rows(tmp_path):
    xml, csv = tmp_path / "array.xml", tmp_path / "array.csv"
    xml.write_text(
        '<?xml version="1.0" encoding="utf-8"?>\n<MicArray name="pair">\n'
        ' <pos Name="Point 1" x="0.1" y="-0.2" z="0.3" />\n'
        ' <pos Name="Point 2" x="-0.1" y="0.2" z="0" />\n</MicArray>\n'
    )
    csv.write_text("channel,x,y,z\n1,0.1,-0.2,0.3\n2,-0.1,0.2,0\n")
    assert array_text(read_array(xml)) == array_text(read_array(csv))


@given(
    places=st.lists(st.tuples(*3 * [st.integers(-4000, 4000)]), min_size=2, unique=True),
    gain=st.floats(-100.0, 100.0),
    face=st.sampled_from(("", "left", "2")),
)
def test_written_arrays_are_read_back_exactly(tmp_path_factory, places, gain, face):
    position = np.array(places) * 1e-3
    path = tmp_path_factory.mktemp("arrays") / "array.csv"
    written = Microphones(
        channel=np.arange(1, len(places) + 1),
        position=position,
        gain_db=np.full(len(places), gain),
        face=("", *(len(places) - 1) * [face]),
    )
    write_array(path, written)
    found = read_array(path)
    assert (found.position == position).all()
    assert (found.gain_db == gain).all()
    assert found.face == written.face


def test_writing_does_not_replace_a_file(tmp_path):
    path = tmp_path / "array.csv"
    path.write_text(PAIR)
    with pytest.raises(InputError, match="new name"):
        write_array(path, read_array(path))
    assert path.read_text() == PAIR
