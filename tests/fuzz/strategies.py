"""Strategies for requests: valid ones, and valid ones with faults anywhere in the message."""

import math

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from hypothesis import strategies as st

from cab.forecast.v1 import consistency_service_pb2 as consistency
from cab.forecast.v1 import model_service_pb2 as models
from cab.forecast.v1 import prediction_service_pb2 as pb

NASTY_FLOATS = st.one_of(
    st.sampled_from(
        [math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, 1e-300, 1e7, -1e7, 1e10, 1e18, 1.7e308, -1.7e308]
    ),
    st.floats(),
)
NASTY_TEXT = st.one_of(
    st.text(max_size=200), st.sampled_from(["", "\x00", "🚗", "a" * 129, "cab@", "@", "@1.0"])
)
NAMES = st.one_of(st.sampled_from(["a", "b", "agent-0"]), NASTY_TEXT)
NASTY_UNSIGNED = st.sampled_from([0, 1, 3, 26, 2000, 2001, 2**31, 2**32 - 1])
NASTY_BYTES = st.one_of(
    st.binary(max_size=300), st.binary(max_size=300).map(lambda tail: b"\x89PNG\r\n\x1a\n" + tail)
)
NASTY = {
    FieldDescriptor.CPPTYPE_DOUBLE: NASTY_FLOATS,
    FieldDescriptor.CPPTYPE_UINT32: NASTY_UNSIGNED,
    FieldDescriptor.CPPTYPE_ENUM: st.sampled_from([0, 1, 2, 3, 4, 5, 99, -1]),
    FieldDescriptor.CPPTYPE_BOOL: st.booleans(),
}


@st.composite
def histories(draw: st.DrawFn, now: float) -> list[pb.AgentState]:
    """Generate a plausible history."""
    count, step = draw(st.integers(1, 6)), draw(st.sampled_from([0.1, 0.25, 0.5]))
    age = draw(st.sampled_from([0.0, 0.04, 0.3]))
    x, y = draw(st.floats(-60, 60)), draw(st.floats(-60, 60))
    vx, vy = draw(st.floats(-30, 30)), draw(st.floats(-30, 30))
    given = draw(st.sets(st.sampled_from(["heading", "velocity", "acceleration", "heading_rate"])))
    result = []
    for k in range(count):
        before = age + step * (count - 1 - k)
        state = pb.AgentState(time=now - before, x=x - vx * before, y=y - vy * before)
        if "heading" in given:
            state.heading = draw(st.floats(-7, 7))
        if "velocity" in given:
            state.velocity_x, state.velocity_y = vx, vy
        if "acceleration" in given:
            state.acceleration_x, state.acceleration_y = draw(st.floats(-5, 5)), 0.5
        if "heading_rate" in given:
            state.heading_rate = draw(st.floats(-1, 1))
        result.append(state)
    return result


def images(rows: int, columns: int) -> st.SearchStrategy[pb.LayerImage]:
    """Generate striped map layers."""
    size = (3 * rows * columns + 7) // 8
    return st.integers(0, 255).map(lambda b: pb.LayerImage(packed_bits=bytes([b]) * (size - 1) + b"\x00"))


@st.composite
def agents(draw: st.DrawFn, now: float, index: int) -> pb.Agent:
    """Generate an agent."""
    kind = draw(st.sampled_from([1, 1, 1, 2, 3, 4]))
    agent = pb.Agent(id=f"agent-{index}", type=kind, states=draw(histories(now)))  # type: ignore[arg-type]
    if draw(st.sampled_from([False, False, True])):
        agent.predict = draw(st.booleans())
    if draw(st.sampled_from([False, False, False, True])):
        agent.map_patch.image.CopyFrom(draw(images(100, 100)))
    if draw(st.sampled_from([False, False, False, True])):
        agent.far_map_patch.image.CopyFrom(draw(images(100, 100)))
    return agent


@st.composite
def rasters(draw: st.DrawFn) -> pb.SceneRaster:
    """Generate a scene raster."""
    rows, columns = draw(st.integers(1, 54)), draw(st.integers(1, 54))
    return pb.SceneRaster(
        image=draw(images(rows, columns)),
        rows=rows,
        columns=columns,
        origin_x=draw(st.floats(-80, 20)),
        origin_y=draw(st.floats(-80, 20)),
        pixels_per_meter=draw(st.sampled_from([0.1, 0.5, 1.0, 3.0, 100.0])),
    )


@st.composite
def options(draw: st.DrawFn) -> pb.PredictOptions:
    """Generate options."""
    result = pb.PredictOptions(
        max_modes=draw(st.sampled_from([0, 1, 5, 25, 26])),
        samples=draw(st.sampled_from([0, 0, 1, 20])),
        context=draw(st.sampled_from([0, 1, 2])),  # type: ignore[arg-type]
        strict=draw(st.sampled_from([False, False, True])),
        merge=draw(st.booleans()),
    )
    if draw(st.booleans()):
        result.seed = draw(st.integers(0, 2**32 - 1))
    if draw(st.booleans()):
        result.horizon = draw(st.sampled_from([0.5, 1.0, 3.0, 6.0]))
    return result


@st.composite
def good_requests(draw: st.DrawFn, model_names: list[str]) -> pb.PredictRequest:
    """Generate requests that are valid, apart from what agents may lack."""
    now = draw(st.sampled_from([0.0, 12.5, 1_700_000_000.25]))
    result = pb.PredictRequest(
        time=now,
        model=draw(st.sampled_from(model_names)),
        agents=[draw(agents(now, index)) for index in range(draw(st.integers(0, 4)))],
    )
    if draw(st.booleans()):
        result.scene_raster.CopyFrom(draw(rasters()))
    if draw(st.booleans()):
        result.options.CopyFrom(draw(options()))
    return result


@st.composite
def requests(draw: st.DrawFn, model_names: list[str]) -> pb.PredictRequest:
    """Generate valid requests with up to three faults."""
    request = draw(good_requests(model_names))
    for _ in range(draw(st.sampled_from([0, 0, 1, 1, 2, 3]))):
        spoil(draw, request)
    return request


def spoil(draw: st.DrawFn, message: Message) -> None:
    """Change one value somewhere in a message."""
    nested: list[Message] = []
    for present, value in message.ListFields():
        if present.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
            nested += list(value) if present.is_repeated else [value]
    if nested and draw(st.sampled_from([False, True, True, True])):
        spoil(draw, draw(st.sampled_from(nested)))
        return
    field = message.DESCRIPTOR.fields_by_name[draw(st.sampled_from(list(message.DESCRIPTOR.fields_by_name)))]
    if field.is_repeated:
        items = list(getattr(message, field.name))
        if items:
            change = draw(st.sampled_from(["drop", "double", "reverse", "many"]))
            chosen = draw(st.integers(0, len(items) - 1))
            message.ClearField(field.name)
            changed = {
                "drop": items[:chosen] + items[chosen + 1 :],
                "double": [*items, items[chosen]],
                "reverse": items[::-1],
                "many": items * 4,
            }[change]
            getattr(message, field.name).extend(changed)
    elif field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE or draw(st.sampled_from([False, False, True])):
        message.ClearField(field.name)
    elif field.cpp_type == FieldDescriptor.CPPTYPE_STRING:
        text = field.type == FieldDescriptor.TYPE_STRING
        setattr(message, field.name, draw(NASTY_TEXT) if text else draw(NASTY_BYTES))
    else:
        setattr(message, field.name, draw(NASTY[field.cpp_type]))


def model_requests(model_names: list[str]) -> st.SearchStrategy[models.GetModelRequest]:
    """Generate requests for one model."""
    return st.one_of(st.sampled_from(model_names), NASTY_TEXT).map(lambda n: models.GetModelRequest(name=n))


def consistency_requests() -> st.SearchStrategy[Message]:
    """Generate requests about scenes and agents, known and unknown."""
    return st.one_of(
        st.builds(
            consistency.GetAgentConsistencyRequest, scene_id=NAMES, agent_id=NAMES, window=NASTY_FLOATS
        ),
        st.builds(consistency.GetSceneConsistencyRequest, scene_id=NAMES),
        st.builds(consistency.ResetSceneRequest, scene_id=NAMES),
    )


def watch_requests() -> st.SearchStrategy[consistency.WatchSceneRequest]:
    """Generate requests to watch a scene."""
    return st.builds(consistency.WatchSceneRequest, scene_id=NAMES)
