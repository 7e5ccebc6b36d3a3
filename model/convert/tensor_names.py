"""The translation of tensor names from the released code's to ours.

Released: ``VEHICLE/decoder/initial_h.weight`` (Trajectron++ and its descendants; ``so/`` and ``state_branch``
are the blind branch of Reweight and RUBiZ). Ours: ``vehicle.full.decoder.initial_h.weight``.
"""

import re
from collections.abc import Mapping

from torch import Tensor

from model.convert.errors import ConversionError

_RENAMED = {
    "node_history_encoder": "history_encoder",
    "edge_influence_encoder": "neighbor_encoder",
    "map_encoder.convs": "map_encoder.convs",
    "map_encoder.fc": "map_encoder.project",
    "node_future_encoder": "future_encoder.lstm",
    "node_future_encoder/initial_h": "future_encoder.initial_h",
    "node_future_encoder/initial_c": "future_encoder.initial_c",
    # Logits of p(z | x) of both branches: the released blind branch has its own, but does not use them
    "hx_to_z": "prior_logits",
    "unicycle_initializer": "full.heading_correction",
    "None/unicycle_initializer": "full.heading_correction",
    "full_branch/unicycle_initializer": "full.heading_correction",
    "state_branch/unicycle_initializer": "blind.heading_correction",
}
"""Modules of a node type."""

_BRANCH = {
    "p_z_x": "prior_hidden",
    "hxy_to_z": "posterior_logits",
    "decoder/initial_h": "decoder.initial_h",
    "decoder/state_action.0": "decoder.initial_action",
    "decoder/rnn_cell": "decoder.cell",
    "decoder/proj_to_GMM_mus": "decoder.mean",
    "decoder/proj_to_GMM_log_sigmas": "decoder.log_sigma",
    "decoder/proj_to_GMM_corrs": "decoder.correlation",
}
"""Modules of a branch; those of the blind one have the prefix ``so/``."""

_UNUSED = frozenset(
    {
        "decoder/proj_to_GMM_log_pis",  # weights of a mixture of one component
        "so/decoder/proj_to_GMM_log_pis",
        "so/hx_to_z",
        "decoder/rubi/proj_to_sigmas",
        "decoder/rubi/proj_to_corrs",
    }
)
"""Modules without influence on the forecast or the loss (no gradient reaches them)."""

_MODULES = {
    **_RENAMED,
    **{theirs: f"full.{ours}" for theirs, ours in _BRANCH.items()},
    **{f"so/{theirs}": f"blind.{ours}" for theirs, ours in _BRANCH.items()},
}

_NODE_TYPES = {"VEHICLE": "vehicle", "PEDESTRIAN": "pedestrian"}
_EDGE = re.compile(r"(\w+)->(\w+)/edge_encoder")
_SINGLE_LAYER = ("history_encoder", "neighbor_encoder.edges")
"""Our LSTMs of one layer and one direction, whose parameters have no suffix for the layer."""


def rename(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename tensors of the released code to our names, leaving out unused ones.

    Args:
        tensors: tensors by the released code's names.

    Raises:
        ConversionError: a name is unknown, or two names mean the same tensor.
    """
    renamed: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        ours = our_name(name)
        if ours is None:
            continue
        if ours in renamed:
            raise ConversionError(f"{name}: there is another tensor for {ours}")
        renamed[ours] = tensor
    return renamed


def our_name(name: str) -> str | None:
    """Return our name for a tensor of the released code; None for an unused one."""
    module, _, parameter = name.rpartition(".")
    if edge := _EDGE.fullmatch(module):
        node, neighbor = (_node_type(name, end) for end in edge.groups())
        ours = f"neighbor_encoder.edges.{neighbor}"
    else:
        node_type, _, module = module.partition("/")
        node = _node_type(name, node_type)
        if module in _UNUSED:
            return None
        ours = _lookup(name, module)
    if ours.startswith(_SINGLE_LAYER):
        parameter = parameter.removesuffix("_l0")
    return f"{node}.{ours}.{parameter}"


def _node_type(name: str, theirs: str) -> str:
    try:
        return _NODE_TYPES[theirs]
    except KeyError:
        raise ConversionError(f"{name}: there is no network for {theirs}") from None


def _lookup(name: str, module: str) -> str:
    """Return our name of a module: that of its longest known prefix, followed by the rest."""
    known, rest = module, ""
    while known not in _MODULES:
        known, dot, last = known.rpartition(".")
        if not dot:
            raise ConversionError(f"{name} is not known")
        rest = f".{last}{rest}"
    return _MODULES[known] + rest
