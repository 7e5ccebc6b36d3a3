"""References to models by ``name@version``."""

from collections.abc import Iterable

from cab.forecast.v1 import model_service_pb2 as pb


class ModelReferences:
    """References to models; the loaded ones are complete."""

    def __init__(self) -> None:
        self._loaded: dict[str, pb.ModelReference] = {}

    def set_loaded(self, references: Iterable[pb.ModelReference]) -> None:
        """Replace the loaded models.

        Args:
            references: one reference per loaded model.
        """
        self._loaded = {f"{reference.name}@{reference.version}": reference for reference in references}

    def get(self, full_name: str) -> pb.ModelReference:
        """Return the reference to a model.

        A model that is not loaded here may have forecast on another server with the same store. Its protocol
        is unspecified.

        Args:
            full_name: ``name@version``.
        """
        loaded = self._loaded.get(full_name)
        if loaded is not None:
            return loaded
        name, _, version = full_name.partition("@")
        return pb.ModelReference(name=name, version=version)
