"""Text tables: every column of every schema is read, written, refused and printed as it states."""

from pathlib import Path

import numpy as np
import pytest
from docs import columns_page
from hypothesis import given
from hypothesis import strategies as st

from pipistrelle.config import InputError
from pipistrelle.text_tables import TEXT_COLUMNS, Schema, read_table, table_text
from reference.refused import FORM, refusal_of

WORDS = {"caller": ["boat"], "shape": ["sphere"], "face": []}
VALID = {"caller": "boat", "shape": "sphere", "face": "left", "range_std": "0.1"}
EACH = [(name, column) for name, schema in columns_page.SCHEMAS.items()
        for column in (*schema.columns, *schema.optional)]  # fmt: skip


def words_of(schema):
    return {name: WORDS[name] for name in (*schema.columns, *schema.optional) if name in WORDS}


def written(path, schema, **fields):
    """Write a table of two valid rows and one with other fields, in line 4."""
    names = (*schema.columns, *schema.optional)
    row = [VALID.get(name, "1") for name in names]
    last = [fields.get(name, field) for name, field in zip(names, row, strict=True)]
    path.write_text("\n".join([",".join(names), ",".join(row), ",".join(row), ",".join(last)]))
    return path


def refused(path, schema, *parts):
    refusal_of(lambda: schema.read(path, words_of(schema)), *parts, form=FORM)


@pytest.mark.parametrize(("name", "column"), EACH)
def test_a_field_of_each_column_is_refused_by_line_and_name(tmp_path, name, column):
    schema, path = columns_page.SCHEMAS[name], tmp_path / "a.csv"
    known = TEXT_COLUMNS[column]
    assert schema.read(written(path, schema), words_of(schema)).column[column].size == 3
    words = words_of(schema).get(column)
    if words is None:
        for text in ("left", "nan", "-inf", "1e999", "1_0", "1 2"):
            written(path, schema, **{column: text})
            refused(path, schema, f"{path}, line 4: found {column} {text!r}", "a finite number")
    elif words:
        written(path, schema, **{column: "bat"})
        refused(path, schema, f"line 4: found {column} 'bat', expected {words[0]}")
    may_be_empty = column in (*schema.optional, *schema.empty)
    written(path, schema, **{column: ""})
    if may_be_empty:
        value = schema.read(path, words_of(schema)).column[column][-1]
        missing = -2 if known.whole else np.nan if words is None else ""
        np.testing.assert_array_equal(value, missing)
    else:
        refused(path, schema, f"line 4: found {column} ''")
    if column == "time":
        written(path, schema, time="0.5")
        refused(path, schema, "line 4: found time 0.5 after 1.0", "does not run backwards")
    elif words is None:
        for beyond in (np.nextafter(known.low, -np.inf), np.nextafter(known.high, np.inf)):
            written(path, schema, **{column: repr(float(beyond))})
            refused(path, schema, f"line 4: found {column} ", known.unit)
        if known.whole:
            refused(written(path, schema, **{column: "1.5"}), schema, f"{column} 1.5", "integer")


@pytest.mark.parametrize("name", columns_page.SCHEMAS)
def test_a_wrong_header_or_row_is_refused_with_the_columns(tmp_path, name):
    schema, path = columns_page.SCHEMAS[name], tmp_path / "a.csv"
    first, most = ",".join(schema.columns), ",".join((*schema.columns, *schema.optional))
    may = f", perhaps followed by {', '.join(schema.optional)}" * bool(schema.optional)
    named = "name the columns so"
    wrong = [
        (f"{most},level", named),
        (first.replace(",", ";"), "separate the columns by commas"),
        (",".join(schema.columns[::-1]), named),
        (f"{first},", named),
        (",".join(("u", *schema.columns[1:])), ""),
        (",".join("1" for _ in schema.columns), named),
        *((f"{first},{column},{column}", named) for column in schema.optional[:1]),
    ]
    for header, fix in wrong:
        path.write_text(f"{header}\n1,1,1\n")
        header = header[:80]
        refused(path, schema, f"line 1: found {header!r}", f"the header {first!r}{may}; {fix}")
    row = ",".join(VALID.get(column, "1") for column in schema.columns)
    for odd in (row.rpartition(",")[0], f"{row},1"):
        path.write_text(f"# mine\n{first}\n\n{row}\n{odd}\n")
        count, expected = odd.count(",") + 1, ", ".join(schema.columns)
        found = f"line 5: found {count} fields in {odd!r}, expected {len(schema.columns)}"
        refused(path, schema, found, expected)
    for text in ("", first, "# nothing\n"):
        path.write_text(text)
        refused(path, schema, f"{path}: found no rows, expected rows of {first}")


@pytest.mark.parametrize("name", columns_page.SCHEMAS)
def test_optional_columns_follow_in_any_order_with_blanks_and_quotes(tmp_path, name):
    schema, path = columns_page.SCHEMAS[name], tmp_path / "a.csv"
    names = (*schema.columns, *schema.optional[::-1])
    rows = [", ".join(f'"{name}"' for name in names)]
    rows += [" " + " , ".join(VALID.get(name, "1") for name in names)]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(["# mine", *rows, "", ""]).encode())
    plain = schema.read(written(tmp_path / "plain.csv", schema), words_of(schema))
    table = schema.read(path, words_of(schema))
    assert table.line.tolist() == [3]
    for column, values in plain.column.items():
        assert table.column[column].tolist() == values[:1].tolist()


def test_a_column_that_the_header_lacks_is_empty_in_every_row(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("x,y\n1,2\n")
    schema = Schema(file="a", row="", columns=("x", "y"), optional=("heading", "face"))
    column = schema.read(path, {"face": []}).column
    assert np.isnan(column["heading"]).tolist() == [True]
    assert column["face"].tolist() == [""]


def test_the_first_invalid_line_is_named_whichever_its_column(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("1 2 3\n1 2 up\nleft 2 3\n")
    with pytest.raises(InputError, match=r"line 2: found z 'up'"):
        read_table(path, ("x", "y", "z"), separator=None)


@given(
    st.lists(st.tuples(st.floats(-1e9, 1e9), st.floats(1e-9, 1e6) | st.just(np.nan)), min_size=1)
)
def test_written_numbers_are_read_back_exactly(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("tables") / "a.csv"
    x, distance = np.array(rows).T
    path.write_text(table_text({"x": x, "range": distance}))
    column = read_table(path, ("x", "range"), optional=("range",)).column
    assert column["x"].tobytes() == x.tobytes()
    np.testing.assert_array_equal(column["range"], distance)


def test_readmes_name_each_column_with_unit_and_meaning():
    for schema in columns_page.SCHEMAS.values():
        head, row, *columns = schema.readme().splitlines()
        names = [*schema.columns, *schema.optional]
        assert (head, row.strip()) == (f"{schema.file}: {','.join(names)}", schema.row)
        assert [line.split()[0] for line in columns] == names
        assert all(
            TEXT_COLUMNS[name].meaning in line for name, line in zip(names, columns, strict=True)
        )


def test_every_table_is_printed_on_a_page():
    pages = Path(columns_page.__file__).parent.glob("*.md")
    marks = [mark for page in pages for mark in columns_page.MARK.findall(page.read_text())]
    headers = [(",".join(one.columns), name) for name, one in columns_page.SCHEMAS.items()]
    assert sorted(marks) == sorted(headers)
    printed = columns_page.markdown(columns_page.SCHEMAS["measurements"])
    assert "| `range` | m | to the landmark; empty: passive | above 0 to 1e+06 |" in printed
