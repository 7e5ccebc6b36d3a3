"""Builders of requests, and encoding of map layers."""

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from google.protobuf import json_format
from hypothesis import given
from hypothesis import strategies as st

from cab.forecast.v1.model_service_pb2 import AGENT_TYPE_CYCLIST, AgentType
from cab.forecast.v1.prediction_service_pb2 import (
    CONTEXT_BLIND,
    CONTEXT_FULL,
    HISTORY_SOURCE_MEMORY,
    HISTORY_SOURCE_UNSPECIFIED,
    LayerImage,
    PredictRequest,
)
from cab_forecast import agent, map_patch, predict_request, scene_raster
from cab_forecast.layers import Layers, decode_layers, encode_layers

FINITE = st.floats(-1e6, 1e6)
LAYERS = arrays.arrays(np.bool_, st.tuples(st.just(3), st.integers(1, 17), st.integers(1, 17)))


@given(
    states=st.lists(st.tuples(FINITE, FINITE, FINITE, FINITE, FINITE, FINITE), min_size=1, max_size=6),
    given_headings=st.booleans(),
)
def test_agents_round_trip(states: list[tuple[float, ...]], given_headings: bool) -> None:
    table = np.array(states)
    headings = table[:, 3] if given_headings else None
    built = agent("a", "cyclist", table[:, 0], table[:, 1:3], headings=headings, velocities=table[:, 4:6])
    assert (built.id, built.type, built.predict) == ("a", AGENT_TYPE_CYCLIST, True)
    read = [(s.time, s.x, s.y, s.velocity_x, s.velocity_y) for s in built.states]
    np.testing.assert_array_equal(read, table[:, [0, 1, 2, 4, 5]])
    assert all(s.HasField("heading") == given_headings for s in built.states)
    assert not any(s.HasField(name) for s in built.states for name in ("acceleration_x", "heading_rate"))
    request = predict_request(0.0, [built])
    assert json_format.Parse(json_format.MessageToJson(request), PredictRequest()) == request


def test_nan_means_not_observed_for_what_is_optional_only() -> None:
    nan = float("nan")
    built = agent(
        "a", "vehicle", [0, 1], np.array([[0, 0], [nan, 0]]), headings=[nan, 1.0], heading_rates=[0.5, nan]
    )
    first, second = built.states
    assert not first.HasField("heading")
    assert second.heading == 1.0
    assert first.heading_rate == 0.5
    assert not second.HasField("heading_rate")
    assert np.isnan(second.x)  # the server is told, and says what is wrong with it


def test_an_agent_of_one_observation() -> None:
    assert len(agent("a", "unknown", 3.0, [[1.0, 2.0]], predict=False).states) == 1


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"positions": [[0, 0]]}, r"positions must be \[2, 2\], but are \[1, 2\]"),
        ({"headings": [[0, 0]]}, r"headings must be \[2\], but are \[1, 2\]"),
        ({"velocities": [0, 0]}, "velocities"),
        ({"accelerations": [[0, 0, 0]] * 2}, "accelerations"),
        ({"times": [[0, 1]]}, "times"),
        ({"agent_type": "tram"}, "vehicle, pedestrian, cyclist, unknown, not 'tram'"),
        ({"agent_type": "unspecified"}, "not 'unspecified'"),
    ],
)
def test_shapes_and_types_are_checked(changes: dict[str, object], match: str) -> None:
    arguments = {"agent_id": "a", "agent_type": "vehicle", "times": [0, 1], "positions": [[0, 0], [1, 1]]}
    with pytest.raises(ValueError, match=match):
        agent(**{**arguments, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["vehicle", "pedestrian", "cyclist", "unknown"])
def test_types_are_the_contracts(name: str) -> None:
    assert AgentType.Name(agent("a", name, 0, [[0, 0]]).type) == f"AGENT_TYPE_{name.upper()}"  # type: ignore[arg-type]


@given(layers=LAYERS)
def test_layers_round_trip(layers: Layers) -> None:
    rows, columns = layers.shape[1:]
    for encoding in ("packed_bits", "png"):
        image = encode_layers(layers, encoding)
        np.testing.assert_array_equal(decode_layers(image, rows, columns), layers)
    np.testing.assert_array_equal(decode_layers(encode_layers(layers, "png"), 0, 0), layers)


def test_bits_are_in_the_contracts_order() -> None:
    """Order [layer, row, column], eight per byte, first in the highest bit, zeros at the end."""
    layers = np.zeros((3, 2, 2))
    layers[0, 0, 0] = layers[0, 1, 0] = layers[2, 1, 1] = 1
    assert encode_layers(layers).packed_bits == bytes([0b10100000, 0b00010000])


@pytest.mark.parametrize(
    "layers", [np.zeros((2, 4, 4)), np.zeros((3, 4)), np.zeros((3, 0, 4)), np.full((3, 2, 2), 0.5)]
)
def test_layers_must_be_binary_and_three(layers: np.ndarray) -> None:
    with pytest.raises(ValueError, match="layers must be"):
        encode_layers(layers)


def test_unknown_encoding() -> None:
    with pytest.raises(ValueError, match="'jpeg'"):
        encode_layers(np.zeros((3, 2, 2)), "jpeg")  # type: ignore[arg-type]


def test_images_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="2 × 2 pixels, not 3 × 2"):
        decode_layers(encode_layers(np.zeros((3, 2, 2)), "png"), 3, 2)
    with pytest.raises(ValueError, match="1 bytes cannot be"):
        decode_layers(LayerImage(packed_bits=b"0"), 2, 2)
    with pytest.raises(ValueError, match="0 bytes cannot be"):
        decode_layers(LayerImage(), 0, 0)


def test_rasters_and_patches() -> None:
    raster = scene_raster(np.ones((3, 4, 6), dtype=int), (-1.5, 2.5), 2.0, encoding="png")
    assert (raster.rows, raster.columns) == (4, 6)
    assert (raster.origin_x, raster.origin_y, raster.pixels_per_meter) == (-1.5, 2.5, 2.0)
    assert len(map_patch(np.zeros((3, 100, 100))).image.packed_bits) == 3750
    with pytest.raises(ValueError, match=r"\[3, 100, 100\]"):
        map_patch(np.zeros((3, 100, 99)))
    near, far = map_patch(np.zeros((3, 100, 100))), map_patch(np.ones((3, 100, 100)))
    both = agent("a", "vehicle", [0.0], [[1.0, 2.0]], map_patch=near, far_map_patch=far)
    assert (both.map_patch, both.far_map_patch) == (near, far)
    assert not agent("a", "vehicle", [0.0], [[1.0, 2.0]], map_patch=near).HasField("far_map_patch")


def test_the_old_names_of_arguments_are_aliases() -> None:
    near = map_patch(np.zeros((3, 100, 100)))
    one = [0.0], [[1.0, 2.0]]
    assert agent("a", "vehicle", *one, patch=near) == agent("a", "vehicle", *one, map_patch=near)
    with pytest.raises(ValueError, match="either map_patch or its alias patch"):
        agent("a", "vehicle", *one, map_patch=near, patch=near)
    assert predict_request(1.0, [], blind=True) == predict_request(1.0, [], context="blind")
    assert predict_request(1.0, [], blind=False) == predict_request(1.0, [], context="full")
    with pytest.raises(ValueError, match="either context or its alias blind"):
        predict_request(1.0, [], context="blind", blind=True)


def test_options() -> None:
    plain = predict_request(1.0, [])
    assert plain.time == 1.0
    assert not plain.HasField("scene_raster")
    assert plain.options.context == CONTEXT_FULL
    assert not plain.options.HasField("seed")
    assert not plain.options.HasField("horizon")
    assert plain.options.history == HISTORY_SOURCE_UNSPECIFIED  # servers that do not know of it understand
    assert not plain.options.consistency
    assert plain.options.merge
    full = predict_request(
        1.0,
        [],
        scene_id="s",
        model="m@1",
        max_modes=2,
        merge=False,
        samples=3,
        seed=0,
        horizon=1.5,
        context="blind",
        strict=True,
        history="memory",
        consistency=True,
        priority=3,
    )
    assert (full.scene_id, full.model) == ("s", "m@1")
    options = full.options
    assert (options.max_modes, options.samples, options.seed, options.horizon) == (2, 3, 0, 1.5)
    assert options.HasField("seed")
    assert options.context == CONTEXT_BLIND
    assert options.strict
    assert options.history == HISTORY_SOURCE_MEMORY
    assert options.consistency
    assert options.priority == 3
    assert not options.merge
    with pytest.raises(ValueError, match="full, blind, not 'none'"):
        predict_request(1.0, [], context="none")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="request, memory, not 'both'"):
        predict_request(1.0, [], history="both")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="range"):
        predict_request(1.0, [], samples=-1)
