"""The console's modules without a page: decoding, the rolling store, figures from metrics."""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Route

FOLDER = Path(__file__).parents[3] / "service" / "console"
ORIGIN = "http://console.test"


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Page]:
    """A page that can import the modules; no server is asked."""

    def serve(route: Route) -> None:
        name = route.request.url.removeprefix(f"{ORIGIN}/console/")
        body = (FOLDER / name).read_text(encoding="utf-8") if name.endswith(".js") else "<!doctype html>"
        route.fulfill(body=body, content_type="text/javascript" if name.endswith(".js") else "text/html")

    with browser.new_context() as context:
        context.route(f"{ORIGIN}/**", serve)
        made = context.new_page()
        made.goto(f"{ORIGIN}/console/empty.html")
        yield made


def call(page: Page, module: str, body: str, argument: object = None) -> Any:
    """Return what a function's body returns; the module is ``m``, the argument ``a``."""
    script = f"async a => {{ const m = await import('/console/{module}.js'); {body} }}"
    return page.evaluate(script, argument)


def test_events_come_whole_however_the_stream_is_cut(page: Page) -> None:
    text = ': heartbeat\n\ndata: {"frame":1}\r\n\r\nevent: error\ndata: two\ndata: lines\n\ndata: not ended'
    body = """const found = [];
        for (let size = 1; size < 20; size += 1) {
            const events = [];
            const parser = new m.EventParser((type, data) => events.push([type, data]));
            for (let at = 0; at < a.length; at += size) parser.push(a.slice(at, at + size));
            found.push(JSON.stringify(events));
        }
        return [...new Set(found)];"""
    [events] = call(page, "event_stream", body, text)
    assert json.loads(events) == [["message", '{"frame":1}'], ["error", "two\nlines"]]


def test_the_store_keeps_30_s_in_order(page: Page) -> None:
    body = """const store = new m.RollingStore();
        for (const time of a) store.add({ time });
        return { times: store.frames.map((frame) => frame.time), restarts: store.restarts,
                 at: store.at(31)?.time, none: store.at(31.5), nearest: store.nearest(30.6).time,
                 step: store.step(31, -1).time, end: store.step(31, 99).time };"""
    found = call(page, "rolling_store", body, [0, 1, 20, 31, 30, 31, 32])
    assert found["times"] == [20, 30, 31, 32]
    assert found["restarts"] == 0
    assert (found["at"], found["none"], found["nearest"]) == (31, None, 31)
    assert (found["step"], found["end"]) == (30, 32)


def test_a_clock_that_jumps_back_begins_the_store_anew(page: Page) -> None:
    body = """const store = new m.RollingStore();
        for (const time of a) store.add({ time });
        return [store.frames.map((frame) => frame.time), store.restarts];"""
    assert call(page, "rolling_store", body, [100, 101, 99.5, 5, 6]) == [[5, 6], 1]


def test_modes_are_unpacked_by_probability(page: Page) -> None:
    body = "return m.unpackModes(a.weights, a.means, a.covariances);"
    packed = {"weights": [0.3, 0.7], "means": list(range(8)), "covariances": list(range(12))}
    assert call(page, "frames", body, packed) == [
        {"weight": 0.7, "mean": [4, 5, 6, 7], "covariance": [6, 7, 8, 9, 10, 11]},
        {"weight": 0.3, "mean": [0, 1, 2, 3], "covariance": [0, 1, 2, 3, 4, 5]},
    ]


@pytest.mark.parametrize(
    ("covariance", "expected"),
    [((4, 0, 1), (2, 1, 0)), ((1, 0, 4), (2, 1, 90)), ((2.5, 1.5, 2.5), (2, 1, 45)), ((0, 0, 0), (0, 0, 0))],
)
def test_ellipses_have_the_axes_of_the_covariance(
    page: Page, covariance: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    axes = call(page, "frames", "return m.ellipse(...a);", list(covariance))
    found = axes["major"], axes["minor"], axes["angle"] * 180 / 3.141592653589793
    assert found == pytest.approx(expected, abs=1e-6)


def test_a_frame_is_sent_back_as_a_request_that_is_not_remembered(page: Page) -> None:
    agent = {
        "type": "AGENT_TYPE_VEHICLE",
        "predicted": True,
        "status": "FORECAST_STATUS_OK",
        "detail": "",
        "warnings": [],
        "states": [{"time": 9.5, "x": 1.0, "y": 2.0}],
        "weights": [1.0],
        "means": [1.0, 2.0],
        "covariances": [1.0, 0.0, 1.0],
    }
    silent = agent | {"id": "b", "predicted": False, "status": "FORECAST_STATUS_UNSPECIFIED", "weights": []}
    wrong = agent | {"id": "c", "status": "FORECAST_STATUS_INVALID", "weights": [], "means": []}
    frame = {"time": 10.0, "map_digest": "AAAA", "agents": [agent | {"id": "a"}, silent, wrong]}
    request = call(
        page, "frames", "return m.predictRequest(m.decodeFrame(a), { model: 'cab', samples: 3 });", frame
    )
    assert request["scene_raster"] == {"digest": "AAAA"}
    assert request["options"] == {"merge": True, "max_modes": 5, "samples": 3}
    assert [(each["id"], each["predict"]) for each in request["agents"]] == [("a", True), ("b", False)]
    assert request["agents"][0]["states"] == agent["states"]
    assert "scene_id" not in request


def test_a_map_is_recoloured(page: Page) -> None:
    image = Image.new("P", (4, 2))
    image.putpalette(
        [0, 0, 0, 255, 0, 0, 0, 255, 0, 255, 255, 0, 0, 0, 255, 255, 0, 255, 0, 255, 255, 9, 9, 9]
    )
    image.putdata(list(range(8)))
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    body = """const colours = m.layerColours({ driveable: [1, 2, 3], road: [4, 5, 6], lane: [7, 8, 9] });
        return [...new Uint8Array(await m.recolour(new Uint8Array(a), colours).arrayBuffer())];"""
    made = Image.open(io.BytesIO(bytes(call(page, "palette", body, list(buffer.getvalue()))))).convert("RGBA")
    road, lane = (4, 5, 6, 255), (7, 8, 9, 255)
    pixels = [made.getpixel((at % 4, at // 4)) for at in range(8)]
    assert pixels == [(0, 0, 0, 0), (1, 2, 3, 255), road, road, lane, lane, road, road]


METRICS = """# HELP calls_total Calls.
calls_total{code="OK",path="a\\"b"} 10.0
calls_total{code="INTERNAL",path=""} 1.0
time_bucket{le="0.1"} 0.0
time_bucket{le="0.2"} 8.0
time_bucket{le="+Inf"} 10.0
time_count 10.0
time_sum 1.5
"""
LATER = METRICS.replace("10.0\n", "30.0\n").replace("8.0", "16.0").replace("1.5", "4.5")


def test_metrics_are_parsed(page: Page) -> None:
    body = """const found = m.parseMetrics(a);
        return [found.get("calls_total"), m.total(found, "calls_total", { code: "OK" })];"""
    samples, total = call(page, "prometheus", body, METRICS)
    assert samples[0] == {"labels": {"code": "OK", "path": 'a"b'}, "value": 10.0}
    assert total == 10.0


@pytest.mark.parametrize(("quantile", "expected"), [(0.0, 0.1), (0.2, 0.15), (0.4, 0.2), (0.99, 0.2)])
def test_quantiles_are_prometheus(page: Page, quantile: float, expected: float) -> None:
    body = """const [before, after] = a.texts.map(m.parseMetrics);
        return m.histogramQuantile(a.quantile, m.bucketGrowth(before, after, "time"));"""
    found = call(page, "prometheus", body, {"texts": [METRICS, LATER], "quantile": quantile})
    assert found == pytest.approx(expected)


def test_figures_are_differences_also_over_a_restart(page: Page) -> None:
    body = """const [before, after] = a.map(m.parseMetrics);
        return [m.meanGrowth(before, after, "time"), [...m.growthBy("code", before, after, "calls_total")],
                m.growth(30, 4), m.meanGrowth(after, after, "time")];"""
    mean, by_code, restarted, nothing = call(page, "prometheus", body, [METRICS, LATER])
    assert mean == pytest.approx(0.15)
    assert by_code == [["OK", 20], ["INTERNAL", 0]]
    assert (restarted, nothing) == (4, None)


def test_one_question_at_a_time_and_the_newest_waits(page: Page) -> None:
    body = """const asked = [];
        let answered = 0;
        const companion = new m.Companion(async ({ time }) => {
            asked.push(time);
            await new Promise((resolve) => setTimeout(resolve, 20));
            return time * 2;
        }, () => { answered += 1; });
        for (const time of [1, 2, 3]) companion.want({ time });
        await new Promise((resolve) => setTimeout(resolve, 100));
        companion.want({ time: 1 });
        return [asked, answered, companion.at(1), companion.at(2), companion.at(3)];"""
    assert call(page, "companion", body) == [[1, 3], 2, 2, None, 6]


def test_zooming_keeps_the_point_under_the_pointer(page: Page) -> None:
    body = """const view = new m.View();
        const size = { width: 800, height: 600 };
        const before = view.toGround(100, 50, size);
        view.zoom(2, 100, 50, size);
        const there = view.toCanvas(...view.toGround(3, 4, size), size);
        return [before, view.toGround(100, 50, size), view.scale, there];"""
    before, after, scale, there = call(page, "view", body)
    assert after == pytest.approx(before)
    assert scale == 10
    assert there == pytest.approx([3, 4])
