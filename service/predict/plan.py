"""Who forecasts which agent of a call, and from what."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Ints
from model.forecaster import Context, Forecaster, Protocol
from model.scenes.resample import MAX_AGE, MAX_GAP, MIN_DIFFERENCE_SPAN, resample
from model.scenes.scene import AgentType, Raster, Scene
from service.errors import BadFields, Fault
from service.predict.batcher import Job
from service.predict.catalog import Catalog
from service.predict.request import Agents, Options, read_agents, read_raster
from service.settings import FALLBACK_MODEL, Settings


@dataclass
class Draft:
    """One agent's place in the answer, filled in as it becomes known."""

    index: int
    """In the request."""
    agent_id: str
    status: pb.ForecastStatus.ValueType
    detail: str = ""
    field: str = ""
    """With INVALID and FALLBACK: what is to blame."""
    row: int = -1
    """In the scene; -1 with INVALID."""
    forecaster: Forecaster | None = None
    """None with INVALID."""
    history_frames: int = 0

    def invalidate(self, fault: Fault) -> None:
        """No forecast after all."""
        self.status = pb.FORECAST_STATUS_INVALID
        self.field, self.detail = fault.field, fault.detail
        self.row, self.forecaster, self.history_frames = -1, None, 0


@dataclass(frozen=True)
class Group:
    """Agents of one call that one forward can take."""

    job: Job
    drafts: list[Draft]
    """In the order of the job's agents."""


@dataclass(frozen=True)
class Plan:
    """A call, decoded: what is to be run, and what is to be answered."""

    options: Options
    agents: Agents
    forecaster: Forecaster
    """The one that was asked for."""
    fallback: Forecaster
    scene: Scene | None
    """Agents that can be used; None when there are none."""
    drafts: list[Draft]
    """One for each agent of the answer, in its order."""
    warnings: list[str]
    groups: list[Group] = field(default_factory=list)

    def add_groups(self, drafts: Iterable[Draft]) -> list[Group]:
        """Prepares the forwards of some drafts, one for each forecaster and agent type.

        Returns:
            The new groups, which are in ``groups`` as well.
        """
        if self.scene is None:
            return []
        members: dict[tuple[int, AgentType], list[Draft]] = {}
        for draft in drafts:
            members.setdefault((id(draft.forecaster), self.scene.types[draft.row]), []).append(draft)
        added = [self._group(self.scene, kind, group) for (_, kind), group in members.items()]
        self.groups.extend(added)
        return added

    def _group(self, scene: Scene, kind: AgentType, drafts: list[Draft]) -> Group:
        forecaster = drafts[0].forecaster
        if forecaster is None:
            raise ValueError("an invalid agent cannot be forecast")
        info = forecaster.info
        context = self.options.context if info.supports_blind else Context.FULL
        seen = replace(scene, states=scene.states.last_frames(info.history_frames))
        targets = np.array([draft.row for draft in drafts], dtype=np.int64)
        with torch.inference_mode():
            features = forecaster.prepare(seen, targets, context)
        return Group(Job(forecaster, kind, context, features, self.options.steps), drafts)


def make_plan(
    request: pb.PredictRequest,
    options: Options,
    forecaster: Forecaster,
    catalog: Catalog,
    settings: Settings,
    agents: Agents | None = None,
) -> Plan:
    """Decodes a request and prepares its forwards. Takes milliseconds: not for the event loop.

    Args:
        request: of which the options were read already.
        options: them.
        forecaster: the one asked for.
        catalog: where the fallback comes from.
        settings: the limits.
        agents: of the request, if they were read already.

    Raises:
        BadField: the map is wrong.
        BadFields: the call is strict, and an agent cannot be forecast as asked.
    """
    raster = read_raster(request, settings)
    if agents is None:
        agents = read_agents(request, settings)
    frames = frames_of(forecaster, catalog)
    scene, rows, faults = _build_scene(request, agents, frames, raster)
    models = forecaster, catalog.fallback
    drafts = []
    for index, agent_id in enumerate(agents.ids):
        if index in faults:
            draft = Draft(index, agent_id, pb.FORECAST_STATUS_INVALID)
            draft.invalidate(faults[index])
            drafts.append(draft)
        elif agents.predict[index] and scene is not None:
            drafts.append(_assign(index, agent_id, scene, rows[index], models))
    plan = Plan(options, agents, forecaster, catalog.fallback, scene, drafts, [])
    check_strict(plan)
    plan.warnings.extend(_warnings(plan))
    plan.add_groups(draft for draft in drafts if draft.forecaster is not None)
    return plan


def frames_of(forecaster: Forecaster, catalog: Catalog) -> int:
    """Frames of history that a call may use."""
    return max(forecaster.info.history_frames, catalog.fallback.info.history_frames)


def check_strict(plan: Plan) -> None:
    """Fails a strict call in which an agent is not forecast as asked.

    Raises:
        BadFields: one fault for each such agent.
    """
    if not plan.options.strict:
        return
    refused = (pb.FORECAST_STATUS_INVALID, pb.FORECAST_STATUS_FALLBACK)
    faults = [Fault(draft.field, draft.detail) for draft in plan.drafts if draft.status in refused]
    if faults:
        raise BadFields(faults)


def fall_back(draft: Draft, fallback: Forecaster, field_path: str, why: str) -> None:
    """Gives an agent to the fallback model."""
    draft.status = pb.FORECAST_STATUS_FALLBACK
    draft.field, draft.detail = field_path, f"forecast by {FALLBACK_MODEL}: {why}"
    draft.forecaster = fallback
    draft.history_frames = min(draft.history_frames, fallback.info.history_frames)


def _build_scene(
    request: pb.PredictRequest, agents: Agents, frames: int, raster: Raster | None
) -> tuple[Scene | None, dict[int, int], dict[int, Fault]]:
    """The usable agents as a scene, their rows in it by request index, and all faults."""
    faults = dict(agents.faults)
    if agents.observations is None:
        return None, {}, faults
    states = resample(agents.observations, request.time, frames)
    now = states.first < states.frames
    kept = now & states.velocity_known
    for row in np.flatnonzero(~kept).tolist():
        index = int(agents.valid[row])
        detail = (
            "a single state needs its velocity, or another state "
            f"{MIN_DIFFERENCE_SPAN} s to {MAX_GAP} s before it"
            if now[row]
            else f"the newest state is more than {MAX_AGE} s old"
        )
        faults[index] = Fault(f"agents[{index}].states", detail)
    if not kept.any():
        return None, {}, faults
    new_row = np.cumsum(kept) - 1
    patches, far_patches = (
        {int(new_row[row]): patch for row, patch in given.items() if kept[row]}
        for given in (agents.patches, agents.far_patches)
    )
    types = [kind for kind, keep in zip(agents.types, kept.tolist(), strict=True) if keep]
    scene = Scene(types, states.select(kept), raster, patches, far_patches)
    indices: Ints = agents.valid[kept]
    return scene, {int(index): row for row, index in enumerate(indices)}, faults


def _assign(
    index: int, agent_id: str, scene: Scene, row: int, models: tuple[Forecaster, Forecaster]
) -> Draft:
    """Decides who forecasts an agent: the first model, or the second where the first cannot."""
    forecaster, fallback = models
    observed = scene.states.frames - int(scene.states.first[row])
    draft = Draft(index, agent_id, pb.FORECAST_STATUS_OK, row=row, forecaster=forecaster)
    draft.history_frames = min(observed, forecaster.info.history_frames)
    kind = scene.types[row]
    heading_known = bool(np.isfinite(scene.states.heading[row, -1]))
    reason = _unfit(forecaster, kind, heading_known)
    if reason is not None:
        if _unfit(fallback, kind, heading_known) is not None:
            draft.invalidate(Fault(f"agents[{index}].{reason[0]}", reason[1]))
            return draft
        draft.history_frames = observed
        fall_back(draft, fallback, f"agents[{index}].{reason[0]}", reason[1])
    elif draft.history_frames < forecaster.info.history_frames:
        draft.status = pb.FORECAST_STATUS_SHORT_HISTORY
        draft.detail = f"{draft.history_frames} of {forecaster.info.history_frames} frames"
    return draft


def _unfit(forecaster: Forecaster, kind: AgentType, heading_known: bool) -> tuple[str, str] | None:
    """Why a model cannot forecast an agent: the field to blame, and the reason; None when it can."""
    if kind not in forecaster.info.agent_types:
        return "type", f"{forecaster.info.name} does not forecast agents of type {kind.value}"
    if not heading_known and forecaster.requires_heading(kind):
        return "states", "heading neither given nor to be told from motion"
    return None


def _warnings(plan: Plan) -> list[str]:
    info = plan.forecaster.info
    warnings = []
    if info.protocol is Protocol.PAPER:
        warnings.append(
            f"{info.full_name} was trained by the paper protocol, with derivatives that look into "
            "the future; on live states it is less accurate than its published figures"
        )
    scene = plan.scene
    if plan.options.context is Context.FULL and scene is not None and scene.raster is None:
        # Of some types a model has learned nothing about the map: those agents lack none
        own = [
            draft
            for draft in plan.drafts
            if draft.forecaster is plan.forecaster and plan.forecaster.looks_at_map(scene.types[draft.row])
        ]
        without = sum(draft.row not in scene.patches for draft in own)
        if without:
            warnings.append(
                f"{info.name} uses the map, but none was given for {without} of {len(own)} agents: "
                "it saw an unknown one"
            )
        far = [draft for draft in own if plan.forecaster.looks_at_far_map(scene.types[draft.row])]
        without_far = sum(draft.row not in scene.far_patches for draft in far)
        if without_far and without_far > without:
            warnings.append(
                f"{info.name} looks as far as 61 m ahead, but no far map was given for {without_far} of "
                f"{len(far)} agents: it saw an unknown one there"
            )
    return warnings
