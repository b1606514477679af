"""What the repository says of a release: one version everywhere, a changelog of one form."""

import re
from pathlib import Path

import yaml

import camtorch as ct

ROOT = Path(__file__).parents[2]
FORMS = ROOT / ".github" / "ISSUE_TEMPLATE"
RELEASE = r"^## \[?(\d+\.\d+\.\d+)\]? - (\d{4}-\d\d-\d\d)$"


def test_version_and_date_are_the_same_everywhere():
    changes = (ROOT / "CHANGELOG.md").read_text()
    (version, date), *older = re.findall(RELEASE, changes, re.M)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert version == citation["version"]
    number, _, dev = ct.__version__.partition(".dev")
    if dev:  # between two releases
        assert tuple(map(int, number.split("."))) > tuple(map(int, version.split(".")))
    else:
        assert number == version
    assert date == citation["date-released"].isoformat()
    assert f'placeholder: "camtorch {version}, torch ' in (FORMS / "defect.yml").read_text()
    order = [tuple(map(int, number.split("."))) for number, _ in ((version, date), *older)]
    assert order == sorted(order, reverse=True)


def test_the_changelog_has_the_sections_of_its_form():
    text = (ROOT / "CHANGELOG.md").read_text()
    headings = re.findall(r"^## (.+)$", text, re.M)
    assert headings[0] == "[Unreleased]"
    assert all(re.match(RELEASE, f"## {heading}") for heading in headings[1:])
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    assert set(re.findall(r"^### (.+)$", text, re.M)) <= kinds
    for name in re.findall(r"^## \[(.+)\]", text, re.M):
        assert re.search(rf"^\[{re.escape(name)}\]: https://", text, re.M), f"{name} has no link"
