from __future__ import annotations

from wheelleg_exp.config.explaining.key_documentation import comment_at, file_comment

SECTION = """\
# @package env.thing
# What the thing is,
# in two lines.
first: 1
second: "a # b"   # kg
# above, at the same depth
third: 3
deep:
  # of the inner key
  inner: [1, 2]

  # left alone

  last: '#'
"""


def test_a_comment_on_the_line_then_the_one_above_it(tmp_path):
    file = tmp_path / "thing.yaml"
    file.write_text(SECTION)
    found = {line.split(":")[0].strip(): comment_at(file, n) for n, line in enumerate(SECTION.splitlines(), 1)}
    assert found["second"] == "kg"
    assert found["third"] == "above, at the same depth"
    assert found["deep"] == ""
    assert found["inner"] == "of the inner key"
    assert found["last"] == ""
    assert comment_at(file, 99) == ""


def test_the_comment_on_top_belongs_to_the_section_and_not_to_its_first_key(tmp_path):
    file = tmp_path / "thing.yaml"
    file.write_text(SECTION)
    assert comment_at(file, 4) == ""
    assert file_comment(file) == "What the thing is, in two lines."


def test_the_comment_on_top_of_a_terms_file_is_the_terms(tmp_path):
    file = tmp_path / "alive.yaml"
    file.write_text("# Not having failed.\nalive:\n  weight: 1.0\n")
    assert comment_at(file, 2) == "Not having failed."
    assert file_comment(file) == ""


def test_a_changed_file_is_read_anew(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("a: 1   # old\n")
    assert comment_at(file, 1) == "old"
    file.write_text("a: 1   # newer\n")
    assert comment_at(file, 1) == "newer"
