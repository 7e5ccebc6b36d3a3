"""The contract's bounds: they name its fields, and the model's sizes are the same."""

from cab.forecast.v1 import bounds
from cab.forecast.v1 import explanation_service_pb2 as explanation_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.scenes import raster, scene


def test_bounds_name_real_fields() -> None:
    for path, (low, high) in bounds.FIELD_BOUNDS.items():
        message, _, field = path.partition(".")
        [found] = [
            file.message_types_by_name[message]
            for file in (pb.DESCRIPTOR, explanation_pb.DESCRIPTOR)
            if message in file.message_types_by_name
        ]
        assert field in found.fields_by_name
        assert low < high


def test_every_number_of_a_state_has_a_bound() -> None:
    fields = {f"AgentState.{field.name}" for field in pb.AgentState.DESCRIPTOR.fields}
    assert fields <= set(bounds.FIELD_BOUNDS)
    for path in fields:
        low, high = bounds.FIELD_BOUNDS[path]
        assert low == -high  # faults say "within ±"


def test_the_model_has_the_contracts_sizes() -> None:
    assert bounds.PATCH_PIXELS == raster.PATCH_SIZE
    assert bounds.STEP_SECONDS == scene.STEP_SECONDS
