"""The strict YAML reader: what it reads, and the one line it says about what it refuses."""

import re

import pytest

from derender.errors import DerenderError
from derender.scene.codec.yaml_tree import parse_number, parse_yaml, read_yaml, write_number


def fault(text, act=lambda top: top.plain()):
    with pytest.raises(DerenderError) as caught:
        act(parse_yaml(text, "bad.yaml"))
    line = str(caught.value)
    assert "\n" not in line and line.startswith("bad.yaml")
    return line


def test_reads_values_with_places():
    top = parse_yaml("a: 0.5\nb:\n  c: 20 deg\n  d: [1, two, 'three 3', true, ~]\n", "x.yaml")
    assert top["a"].number() == 0.5
    c = top["b"].section()["c"]
    assert c.number("rad") == pytest.approx(0.3490658503988659, abs=0) and c.where == "x.yaml, line 3, b.c"
    assert top["b"].plain() == {"c": "20 deg", "d": [1, "two", "three 3", True, None]}
    assert [node.address for node in top["b"]["d"].sequence(5)][1] == "b.d[1]"


@pytest.mark.parametrize(
    "text,value", [("1.0e-3", 1e-3), ("-.5", -0.5), ("5.", 5.0), ("+3", 3.0), ("0", 0.0), ("1.5E+2", 150.0)]
)
def test_strict_decimals(text, value):
    assert parse_number(text) == value


@pytest.mark.parametrize(
    "text,unit,value",
    [
        ("30 deg", "rad", 0.5235987755982988),
        ("5mm", "m", 0.005),
        ("12 cm", "m", 0.12),
        ("250 g", "kg", 0.25),
        ("2 px", "px", 2.0),
        ("1 rad", "rad", 1),
    ],
)
def test_units(text, unit, value):
    assert parse_number(text, unit) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    "text,remedy",
    [
        ("1e-3", "write 1.0e-3"),
        ("1.5e3", "write 1.5e+3"),
        ("-2E5", "write -2.0e+5"),
        ("012", "write 12"),
        (".inf", "finite"),
        ("nan", "finite"),
        ("0x1F", "plain digits"),
        ("1:30", "plain digits"),
        ("1_000", "plain digits"),
        ("1.0e+999", "finite"),
        ("abc", "0.05 or 20 deg"),
        ("5 mm", "write a number and rad or deg, such as 5 deg"),
        ("20 bananas", "write a number and rad or deg, such as 20 deg"),
        ("20°", "such as 20 deg"),
        ("", "0.05 or 20 deg"),
        (".", "0.05 or 20 deg"),
    ],
)
def test_refused_numbers_say_what_is_right(text, remedy):
    with pytest.raises(DerenderError, match=re.escape(remedy)):
        parse_number(text, "rad")


@pytest.mark.parametrize(
    "value", [1e-5, 0.1, 1 / 3, 1e22, 5e-324, 1.7976931348623157e308, -0.0, 3, 123456789.123456789]
)
def test_written_numbers_read_back_bit_for_bit(value):
    assert repr(parse_number(write_number(value))) == repr(float(value))


@pytest.mark.parametrize(
    "text,says",
    [
        ("a: 1\na: 2\n", "line 2: the key 'a' stands here for the second time, first on line 1"),
        ("a:\n\tb: 1\n", "line 2: a tab indents this line; indent with spaces"),
        ("", "line 1: the file is empty"),
        ("- 1\n- 2\n", "line 1: here stands a list; a file starts with keys"),
        ("a: !!python/object:os.system {}\n", "the tag"),
        ("a: 1\n---\nb: 2\n", "line 2: a second document"),
        ("a: {<<: {b: 1}}\n", "merging"),
        ("a: [1, 2\n", "this is not YAML"),
        ("a: &x [*x]\n", "the alias *x has no complete anchor"),
        ("a: *nowhere\n", "the alias *nowhere"),
        ("? [1, 2]\n: 3\n", "a key has to be a name"),
        ("a: " + "[" * 40 + "]" * 40, "nested more than 32 deep"),
        ("a: '\\x00\x00'", "this is not YAML"),
        ("~: 1\n", "a key is empty"),
    ],
)
def test_refused_files(text, says):
    assert says in fault(text)


def test_alias_bomb_is_refused_quickly():
    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
    )
    assert "aliases may have multiplied them" in fault(bomb)


def test_honest_alias_is_read():
    assert parse_yaml("a: &side {uniform: [0, 1]}\nb: *side\n")["b"].plain() == {"uniform": [0, 1]}


def test_not_utf8_names_the_line(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_bytes(b"a: 1\nb: \xff\xfe\n")
    with pytest.raises(DerenderError, match="line 2: this is not text in UTF-8"):
        read_yaml(path)


def test_a_depth_image_is_told_from_a_scene_file(tmp_path):
    path = tmp_path / "frame.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")
    with pytest.raises(DerenderError, match="no scene file.*derender infer"):
        read_yaml(path)


@pytest.mark.parametrize("name", ["missing.yaml", ".", "a\0b"])
def test_unreadable_files(tmp_path, name):
    with pytest.raises(DerenderError):
        read_yaml(f"{tmp_path}/{name}")


@pytest.mark.parametrize(
    "text,act,says",
    [
        ("a: 1", lambda t: t.allow("b", "ab"), "line 1, a: this key is unknown here"),
        ("objets: 1", lambda t: t.allow("objects"), "did you mean 'objects'?"),
        ("a: on", lambda t: t["a"].boolean(), "'on' is not a truth value; write true"),
        ("a: no", lambda t: t["a"].boolean(), "write false"),
        ("a: no", lambda t: t["a"].text(), "no is not text to a YAML reader; write 'no' in quotes"),
        ("a: 12", lambda t: t["a"].text(), "12 is not text"),
        ("a: '0.1'", lambda t: t["a"].number(), "stands in quotes and so is text; write 0.1"),
        ("a:", lambda t: t["a"].number(), "here stands nothing; write a number"),
        ("a: [1]", lambda t: t["a"].number(), "here stands a list; write a number"),
        ("a: 1", lambda t: t["a"].section(), "write a section"),
        ("a: -1", lambda t: t["a"].number(lower=0), "is too small; give at least 0"),
        ("a: 7", lambda t: t["a"].number(upper=5), "is too large; give at most 5"),
        ("a: 1.5", lambda t: t["a"].integer(), "is not a whole number; write 2"),
        ("a: [1, 2]", lambda t: t["a"].sequence(3), "the list has 2 entries; give 3"),
        ("a: cub", lambda t: t["a"].text(["cube", "box"]), "did you mean 'cube'?"),
        ("b: 1", lambda t: t["a"], "'a' is missing"),
        ("a: {b: 1, c: 2}", lambda t: t["a"].section().only(), "2 keys stand here"),
    ],
)
def test_refused_values(text, act, says):
    assert says in fault(text, act)


def test_the_contact_type_on_needs_no_quotes():
    assert parse_yaml("type: on")["type"].text(["on", "6dof"]) == "on"
