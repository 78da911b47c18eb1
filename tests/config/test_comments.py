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


def test_a_key_has_the_comment_on_its_line_or_else_above_it_and_a_section_the_one_at_the_top(tmp_path):
    file = tmp_path / "thing.yaml"
    file.write_text(SECTION)
    found = {line.split(":")[0].strip(): comment_at(file, n) for n, line in enumerate(SECTION.splitlines(), 1)}
    assert (found["first"], file_comment(file)) == ("", "What the thing is, in two lines.")
    assert (found["second"], found["third"], found["deep"]) == ("kg", "above, at the same depth", "")
    assert (found["inner"], found["last"], comment_at(file, 99)) == ("of the inner key", "", "")


def test_the_comment_at_the_top_of_a_terms_file_belongs_to_the_term(tmp_path):
    file = tmp_path / "alive.yaml"
    file.write_text("# Not having failed.\nalive:\n  weight: 1.0\n")
    assert (comment_at(file, 2), file_comment(file)) == ("Not having failed.", "")
