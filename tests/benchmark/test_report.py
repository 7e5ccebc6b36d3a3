import base64
import io
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from PIL import Image

from benchmark.report import plots
from benchmark.report.canvas import png, styles, svg
from benchmark.report.maps import case_map
from benchmark.report.page import write_page
from benchmark.tables import tables
from model.forecaster import Protocol
from tests.benchmark.builders import all_models, made_case, made_metrics, made_model, made_results

HOSTILE = "<script>alert(1)</script>\"'&$\\frac$"
VOID = {"meta", "img", "link", "br"}


class Page(HTMLParser):
    """Contents of a page; its tags must match."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)
            self.texts.setdefault(tag, []).append("")

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open:
            self.texts[self._open[-1]][-1] += data

    def pictures(self) -> list[tuple[str, bytes, str]]:
        """Kind, bytes and alternative text of each."""
        found = []
        for tag, attributes in self.tags:
            if tag == "img":
                kind, content = (attributes["src"] or "").removeprefix("data:").split(";base64,")
                found.append((kind, base64.b64decode(content, validate=True), attributes["alt"] or ""))
        return found


def heights(line: Line2D) -> list[float]:
    """Heights of a line's points."""
    return [float(value) for value in np.asarray(line.get_ydata())]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A page of all models."""
    results = made_results(*all_models(), protocol=Protocol.PAPER)
    cases = [made_case("scene-1", ("cab@1.0.0", "rubiz@1.0.0"), modes=25), made_case("scene-2")]
    file = write_page(results, cases, tmp_path_factory.mktemp("report"))
    assert file.name == "report.html"
    return file.read_text(encoding="utf-8")


def test_the_page_asks_nothing_of_the_network(whole: str) -> None:
    page = Page(whole)
    assert {tag for tag, _ in page.tags}.isdisjoint(
        {"script", "link", "iframe", "object", "embed", "base", "a"}
    )
    for _, attributes in page.tags:
        assert {"href", "srcset", "data", "action"}.isdisjoint(attributes)
        assert not [name for name in attributes if name.startswith("on")]
        assert (attributes.get("src") or "data:").startswith("data:")
    (style,) = page.texts["style"]
    assert "url(" not in style
    assert "@import" not in style
    assert "prefers-color-scheme: dark" in style
    assert not re.search(r"https?:", whole)


def test_pictures_ask_nothing_of_the_network_either(whole: str) -> None:
    for kind, content, _ in Page(whole).pictures():
        if kind != "image/svg+xml":
            continue
        for element in ElementTree.fromstring(content).iter():  # noqa: S314 (our own)
            links = [value for name, value in element.attrib.items() if name.endswith("href")]
            assert all(link.startswith(("#", "data:")) for link in links)


def test_all_tables_are_there(whole: str) -> None:
    made = tables(made_results(*all_models(), protocol=Protocol.PAPER))
    page = Page(whole)
    assert [title for title in page.texts["h2"] if title[0].isdigit()] == [table.title for table in made]
    rows = sum(len(table.rows) for table in made) + len(all_models())
    assert len(page.texts["tr"]) == rows + len(made) + 1
    assert all(table.note in page.texts["p"] for table in made)
    for table in made:
        for row in table.rows:
            assert row[0] in page.texts["th"]
            assert {*row[1:]} <= {*page.texts["td"]}


def test_every_table_and_picture_can_be_scrolled(whole: str) -> None:
    page = Page(whole)
    regions = [attributes for tag, attributes in page.tags if tag == "div"]
    assert {attributes["class"] for attributes in regions} == {"scroll"}
    assert len(regions) == len(page.texts["table"]) + len(page.pictures())


def test_pictures_tell_what_they_show(whole: str) -> None:
    pictures = Page(whole).pictures()
    assert [kind for kind, _, _ in pictures] == ["image/svg+xml"] * 3 + ["image/png"] * 2
    assert "covernet@1.0.0" in pictures[0][2]
    assert "scene-1" in pictures[3][2]
    with Image.open(io.BytesIO(pictures[3][1])) as image:
        assert image.width > 800


def test_a_case_tells_its_errors_the_best_first(whole: str) -> None:
    case = made_case("scene-1", ("cab@1.0.0", "rubiz@1.0.0"), modes=25)
    errors = sorted((forecast.fde_6s_m, key) for key, forecast in case.forecasts.items())
    expected = "; ".join(f"{key} {error:.1f} m" for error, key in errors)
    captions = Page(whole).texts["figcaption"]
    assert f"FDE at 6 s: Kalman filter 38.2 m; {expected}." in captions


def test_the_header_states_the_settings(whole: str) -> None:
    page = Page(whole)
    facts = dict(zip(page.texts["dt"], page.texts["dd"], strict=True))
    assert facts["Endpoint"] == "127.0.0.1:50051"
    assert (facts["Protocol of the inputs"], facts["Seed"], facts["Pairs"]) == ("paper", "3", "10")
    assert "paper protocol, made split some, 10 pairs, seed 3" in page.texts["p"]
    assert "13 forecasts are missing; the figures are of the others." in page.texts["p"]


def test_hostile_names_are_text(tmp_path: Path) -> None:
    model = made_model(HOSTILE)
    results = replace(made_results(model), data=HOSTILE, endpoint=HOSTILE, refusals=(HOSTILE,))
    case = replace(made_case(HOSTILE, (model.key,)), agent=HOSTILE)
    page = Page(write_page(results, [case], tmp_path).read_text(encoding="utf-8"))
    assert "script" not in page.texts
    assert HOSTILE in page.texts["dd"]
    assert HOSTILE in page.texts["li"]
    assert f"{HOSTILE}, agent {HOSTILE}, frame 12" in page.texts["h3"]
    assert any(HOSTILE in alternative for _, _, alternative in page.pictures())


def test_what_is_not_there_is_not_drawn(tmp_path: Path) -> None:
    metrics = {name: value for name, value in made_metrics().items() if name.startswith("ade_ml")}
    results = made_results(replace(made_model("kalman", metrics=metrics), statuses={"OK": 10}, latency=None))
    page = Page(write_page(results, [], tmp_path).read_text(encoding="utf-8"))
    assert len(page.pictures()) == 1
    assert "Hard cases" not in page.texts["h2"]
    assert "Refused calls" not in page.texts["h2"]
    assert any("3. Hard cases: left out" in line for line in page.texts["li"])
    assert not [text for text in page.texts["p"] if "missing" in text]


def test_no_model_has_a_forecast(tmp_path: Path) -> None:
    nothing = replace(made_model(metrics={"ade_ml_1s_m": math.nan}), statuses={"MISSING": 10}, latency=None)
    page = Page(write_page(made_results(nothing), [], tmp_path).read_text(encoding="utf-8"))
    assert page.pictures() == []
    assert "8. Forecast statuses" in page.texts["h2"]


@pytest.mark.parametrize(("protocol", "lines"), [(Protocol.CAUSAL, 1), (Protocol.PAPER, 3)])
def test_the_papers_curves_are_of_the_paper_protocol(protocol: Protocol, lines: int) -> None:
    figure = plots.error_by_horizon(made_results(protocol=protocol))
    assert figure is not None
    assert [len(axes.lines) for axes in figure.axes] == [lines, lines]
    assert heights(figure.axes[0].lines[0]) == pytest.approx([0.08 * second**2 for second in range(1, 7)])
    if protocol is Protocol.PAPER:
        assert heights(figure.axes[1].lines[1])[-1] == 8.02


def test_calibration_has_a_panel_a_model() -> None:
    unknown = made_model("unknown", metrics={"ade_ml_1s_m": 1.0})
    figure = plots.calibration(made_results(made_model(), unknown, made_model("rubiz")))
    assert figure is not None
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["cab@1.0.0", "rubiz@1.0.0"]
    observed = [found for line in figure.axes[0].lines if len(found := heights(line)) == 6]
    assert [values[0] for values in observed] == pytest.approx([0.5 / 1.02, 0.9 / 1.02, 0.99 / 1.02])


def test_bars_are_as_long_as_their_figures() -> None:
    figure = plots.consistency(made_results())
    assert figure is not None
    widths = [[bar.get_width() for bar in axes.patches if isinstance(bar, Rectangle)] for axes in figure.axes]
    assert widths[0] == pytest.approx([2.0, 3.0, math.hypot(2.0, 3.0)])
    assert widths[1] == pytest.approx([math.sqrt(0.2), 1.0, math.sqrt(5.0)])


def test_the_same_figures_are_the_same_picture() -> None:
    drawn = [plots.consistency(made_results(protocol=Protocol.PAPER)) for _ in range(2)]
    assert drawn[0] is not None
    assert drawn[1] is not None
    assert svg(drawn[0]) == svg(drawn[1])


def test_styles_are_told_apart() -> None:
    found = styles(f"model-{number}" for number in range(20))
    assert len({(style.color, style.line) for style in found.values()}) == 20
    assert len({style.marker for style in list(found.values())[:13]}) == 13


def test_a_case_off_the_map_is_drawn_all_the_same() -> None:
    case = made_case()
    far = replace(case, raster=replace(case.raster, origin=case.raster.origin + 5000.0))
    figures = [case_map(one, styles(case.forecasts)) for one in (case, far)]
    # Of the one that is off there is an empty pixel, somewhere else
    sizes = [np.asarray(figure.axes[0].images[0].get_array()).shape[:2] for figure in figures]
    assert sizes[0] != sizes[1] == (1, 1)
    assert png(figures[1]).startswith(b"\x89PNG")


def test_the_likelier_mode_is_the_stronger_line() -> None:
    case = made_case(modes=3)
    forecast = replace(case.forecasts["cab@1.0.0"], weights=np.array([0.6, 0.397, 0.003]))
    figure = case_map(replace(case, forecasts={"cab@1.0.0": forecast}), styles(case.forecasts))
    strengths = [alpha for line in figure.axes[1].lines if (alpha := line.get_alpha()) is not None]
    assert len(strengths) == 2
    assert strengths[0] > strengths[1]


def test_a_forecast_that_goes_far_does_not_make_everything_tiny() -> None:
    case = made_case()
    forecast = case.forecasts["cab@1.0.0"]
    runaway = replace(forecast, most_likely=forecast.most_likely + np.linspace(0, 900, 12)[:, None])
    axes = case_map(replace(case, forecasts={"cab@1.0.0": runaway}), styles(case.forecasts)).axes[0]
    (left, right), (truth, _) = axes.get_xlim(), case.truth[-1]
    assert right - left < 220
    assert left < truth < right
