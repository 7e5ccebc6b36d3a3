"""References to models that are loaded, and to those of other servers."""

from cab.forecast.v1 import model_service_pb2 as pb
from service.tracking.model_references import ModelReferences

CAB = pb.ModelReference(name="cab", version="1.0.0", protocol=pb.INPUT_PROTOCOL_CAUSAL)
PAPER = pb.ModelReference(name="cab", version="1.1.0", protocol=pb.INPUT_PROTOCOL_PAPER)


def test_a_loaded_model_is_known_with_its_protocol() -> None:
    references = ModelReferences()
    assert references.get("cab@1.0.0").protocol == pb.INPUT_PROTOCOL_UNSPECIFIED
    references.set_loaded([CAB, PAPER])
    assert references.get("cab@1.0.0") == CAB
    assert references.get("cab@1.1.0") == PAPER


def test_of_another_server_s_model_name_and_version_are_known() -> None:
    references = ModelReferences()
    references.set_loaded([CAB])
    assert references.get("cab@2.0.0") == pb.ModelReference(name="cab", version="2.0.0")
    assert references.get("mine") == pb.ModelReference(name="mine")
