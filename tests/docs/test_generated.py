"""The generated parts of the documentation are those that the code and the data give."""

import pytest

from docs import generate
from service.settings import Settings
from service.settings_reference import attribute_docstrings


@pytest.mark.parametrize("page", generate.PAGES)
def test_a_page_is_up_to_date(page: str) -> None:
    text = (generate.DOCS / page).read_text(encoding="utf-8")
    assert text == generate.render(page), "run: make docs"


@pytest.mark.parametrize("name", Settings.model_fields)
def test_every_setting_is_explained(name: str) -> None:
    assert attribute_docstrings(Settings).get(name), f"service.settings.Settings.{name} has no docstring"


def test_a_page_without_its_marker_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(generate.PAGES, "settings.md", {"no such part": lambda: ""})
    with pytest.raises(ValueError, match="must hold"):
        generate.render("settings.md")


def test_the_settings_table_tells_defaults_and_bounds() -> None:
    [row] = [line for line in generate.settings_table().splitlines() if "FORECAST_TRACK_EXPIRY" in line]
    assert [cell.strip() for cell in row.split("|")][3:5] == ["`30`", "≥ 10"]
