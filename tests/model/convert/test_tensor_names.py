from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from model.convert.errors import ConversionError
from model.convert.tensor_names import rename
from model.networks.config import BlindContext, NetworkConfig
from model.networks.forecaster import CvaeNetworks

ONE = torch.ones(1)


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [
        ("VEHICLE/node_history_encoder.weight_ih_l0", "vehicle.history_encoder.weight_ih"),
        ("PEDESTRIAN/node_history_encoder.bias_hh_l0", "pedestrian.history_encoder.bias_hh"),
        (
            "VEHICLE->PEDESTRIAN/edge_encoder.weight_hh_l0",
            "vehicle.neighbor_encoder.edges.pedestrian.weight_hh",
        ),
        ("VEHICLE/edge_influence_encoder.w2.weight", "vehicle.neighbor_encoder.w2.weight"),
        ("VEHICLE/map_encoder.convs.2.bias", "vehicle.map_encoder.convs.2.bias"),
        ("VEHICLE/map_encoder.fc.weight", "vehicle.map_encoder.project.weight"),
        (
            "VEHICLE/node_future_encoder.weight_ih_l0_reverse",
            "vehicle.future_encoder.lstm.weight_ih_l0_reverse",
        ),
        ("VEHICLE/node_future_encoder.bias_hh_l0", "vehicle.future_encoder.lstm.bias_hh_l0"),
        ("VEHICLE/node_future_encoder/initial_c.bias", "vehicle.future_encoder.initial_c.bias"),
        ("VEHICLE/hx_to_z.weight", "vehicle.prior_logits.weight"),
        ("VEHICLE/p_z_x.bias", "vehicle.full.prior_hidden.bias"),
        ("VEHICLE/hxy_to_z.bias", "vehicle.full.posterior_logits.bias"),
        ("VEHICLE/decoder/state_action.0.weight", "vehicle.full.decoder.initial_action.weight"),
        ("VEHICLE/decoder/rnn_cell.weight_ih", "vehicle.full.decoder.cell.weight_ih"),
        ("VEHICLE/so/decoder/proj_to_GMM_mus.bias", "vehicle.blind.decoder.mean.bias"),
        ("VEHICLE/so/p_z_x.bias", "vehicle.blind.prior_hidden.bias"),
        ("VEHICLE/unicycle_initializer.bias", "vehicle.full.heading_correction.bias"),
        ("VEHICLE/None/unicycle_initializer.bias", "vehicle.full.heading_correction.bias"),
        ("VEHICLE/full_branch/unicycle_initializer.bias", "vehicle.full.heading_correction.bias"),
        ("VEHICLE/state_branch/unicycle_initializer.bias", "vehicle.blind.heading_correction.bias"),
    ],
)
def test_names(theirs: str, ours: str) -> None:
    assert list(rename({theirs: ONE})) == [ours]


@pytest.mark.parametrize(
    "name",
    [
        "VEHICLE/decoder/proj_to_GMM_log_pis.weight",
        "VEHICLE/so/decoder/proj_to_GMM_log_pis.bias",
        "VEHICLE/so/hx_to_z.weight",
        "VEHICLE/decoder/rubi/proj_to_sigmas.weight",
        "VEHICLE/decoder/rubi/proj_to_corrs.bias",
    ],
)
def test_what_is_not_used_is_left_out(name: str) -> None:
    assert rename({name: ONE}) == {}


@pytest.mark.parametrize(
    "name",
    [
        "",
        "weight",
        "VEHICLE/weight",
        "VEHICLE/decoder/unknown.weight",
        "VEHICLE/decoder/initial_hidden.weight",
        "VEHICLE/so/map_encoder.fc.weight",
        "BICYCLE/p_z_x.bias",
        "VEHICLE->BICYCLE/edge_encoder.bias_ih_l0",
        "VEHICLE->VEHICLE/other.bias_ih_l0",
    ],
)
def test_unknown_names_are_refused(name: str) -> None:
    with pytest.raises(ConversionError):
        rename({name: ONE})


def test_two_tensors_for_one_are_refused() -> None:
    names = ["VEHICLE/None/unicycle_initializer.bias", "VEHICLE/full_branch/unicycle_initializer.bias"]
    with pytest.raises(ConversionError, match="another tensor for vehicle"):
        rename(dict.fromkeys(names, ONE))


@pytest.mark.parametrize(
    ("method", "blind"),
    [
        ("trajectron", BlindContext.NONE),
        ("cab", BlindContext.NULL),
        ("reweight", BlindContext.OWN),
        ("rubiz", BlindContext.OWN),
    ],
)
def test_golden_weights_are_those_of_our_networks(shared: Path, method: str, blind: BlindContext) -> None:
    renamed = rename(load_file(shared / f"reference/golden/losses/{method}.safetensors"))
    with torch.device("meta"):
        ours = CvaeNetworks(NetworkConfig(blind=blind)).state_dict()
    assert {name: tensor.shape for name, tensor in renamed.items()} == {
        name: tensor.shape for name, tensor in ours.items()
    }
