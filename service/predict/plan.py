"""Plan of a call: the forecaster of each agent, the forwards that follow, and what came of them."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Ints
from model.forecaster import Context, Forecaster, Protocol
from model.mixture import MergedModes, merge_modes
from model.scenes.resample import MAX_AGE, MAX_GAP, MIN_DIFFERENCE_SPAN, resample
from model.scenes.scene import AgentType, Raster, Scene
from service.errors import BadFields, Fault
from service.predict.batcher import Job, Outcome
from service.predict.catalog import Catalog
from service.predict.forward import finite
from service.predict.input_warnings import Warnings, input_warnings, of_context_agents
from service.predict.request import Agents, Options, read_agents, read_raster
from service.settings import FALLBACK_MODEL, Settings


@dataclass
class Draft:
    """One agent's forecast in the response, filled in as it becomes known."""

    index: int
    """Index of the agent in the request."""
    agent_id: str
    status: pb.ForecastStatus.ValueType
    detail: str = ""
    field: str = ""
    """Path of the field at fault, with INVALID and FALLBACK."""
    row: int = -1
    """Row of the agent in the scene; -1 with INVALID."""
    forecaster: Forecaster | None = None
    """None with INVALID."""
    history_frames: int = 0

    def invalidate(self, fault: Fault) -> None:
        """Set the status INVALID: there is no forecast."""
        self.status = pb.FORECAST_STATUS_INVALID
        self.field, self.detail = fault.field, fault.detail
        self.row, self.forecaster, self.history_frames = -1, None, 0

    def fall_back(self, fallback: Forecaster, field_path: str, reason: str) -> None:
        """Assign the agent to the fallback model."""
        self.status = pb.FORECAST_STATUS_FALLBACK
        self.field, self.detail = field_path, f"forecast by {FALLBACK_MODEL}: {reason}"
        self.forecaster = fallback
        self.history_frames = min(self.history_frames, fallback.info.history_frames)


@dataclass
class Group:
    """Agents of one call that share a forward, and its outcome."""

    job: Job
    drafts: list[Draft]
    """In the order of the job's agents; once it has run, only those with finite forecasts."""
    outcome: Outcome | None = None
    """None until the job has run; its mixture is that of ``drafts``."""
    _merged: MergedModes | None = field(default=None, repr=False)

    def merged(self) -> MergedModes:
        """Return the merged modes of the outcome, which are merged once.

        Raises:
            ValueError: the job has not run.
        """
        if self.outcome is None:
            raise ValueError("the job has not run")
        if self._merged is None:
            self._merged = merge_modes(self.outcome.mixture)
        return self._merged

    def set_outcome(self, outcome: Outcome) -> list[Draft]:
        """Store the outcome of the job.

        Returns:
            The drafts whose forecasts are not finite; they and their forecasts are dropped.
        """
        good = finite(outcome.mixture)
        if good.all():
            self.outcome = outcome
            return []
        broken = [draft for draft, fine in zip(self.drafts, good.tolist(), strict=True) if not fine]
        rows = np.flatnonzero(good)
        self.drafts = [self.drafts[row] for row in rows.tolist()]
        self.outcome = replace(outcome, mixture=outcome.mixture[torch.from_numpy(rows)])
        return broken


@dataclass(frozen=True)
class Plan:
    """A validated call: the forwards to run, and the forecasts of the response."""

    options: Options
    agents: Agents
    forecaster: Forecaster
    """The requested model."""
    fallback: Forecaster
    scene: Scene | None
    """Usable agents; None if there are none."""
    drafts: list[Draft]
    """One per forecast of the response, in its order."""
    warnings: list[str]
    input_warnings: Warnings
    """Contradictions in the input of agents."""
    rows: dict[int, int] = field(default_factory=dict)
    """Rows of the usable agents in the scene, by index in the request."""
    groups: list[Group] = field(default_factory=list)

    @property
    def ids(self) -> dict[int, str]:
        """Ids of the agents of the scene, by row."""
        return {row: self.agents.ids[index] for index, row in self.rows.items()}

    def add_groups(self, drafts: Iterable[Draft]) -> list[Group]:
        """Prepare the forwards of drafts, one per forecaster and agent type.

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

    def replace_broken(self, broken: Sequence[Draft]) -> list[Group]:
        """Assign agents without finite forecasts to the fallback; those that it forecast become INVALID.

        Returns:
            The new groups, which are in ``groups`` as well.
        """
        for draft in broken:
            failed = draft.forecaster
            if failed is None:
                continue
            reason = f"the forecast of {failed.info.name} was not finite"
            path = f"agents[{draft.index}]"
            if failed is self.fallback:
                draft.invalidate(Fault(path, reason))
            else:
                draft.fall_back(self.fallback, path, reason)
        return self.add_groups(draft for draft in broken if draft.forecaster is not None)

    def check_strict(self) -> None:
        """Fail a strict call in which an agent is not forecast as requested.

        Raises:
            BadFields: one fault per such agent.
        """
        if not self.options.strict:
            return
        refused = (pb.FORECAST_STATUS_INVALID, pb.FORECAST_STATUS_FALLBACK)
        faults = [Fault(draft.field, draft.detail) for draft in self.drafts if draft.status in refused]
        if faults:
            raise BadFields(faults)

    def _group(self, scene: Scene, kind: AgentType, drafts: list[Draft]) -> Group:
        forecaster = drafts[0].forecaster
        if forecaster is None:
            raise ValueError("an invalid agent cannot be forecast")
        info = forecaster.info
        context = self.options.context if info.supports_blind else Context.FULL
        seen = replace(scene, states=scene.states.last_frames(info.history_frames))
        targets = np.array([draft.row for draft in drafts], dtype=np.int64)
        with torch.inference_mode():
            inputs = forecaster.view(seen, targets, context)
        return Group(Job(forecaster, kind, context, inputs, self.options.steps), drafts)


def make_plan(
    request: pb.PredictRequest,
    options: Options,
    forecaster: Forecaster,
    catalog: Catalog,
    settings: Settings,
    agents: Agents | None = None,
    raster: Raster | None = None,
) -> Plan:
    """Read map and agents of a request and prepare its forwards. Takes milliseconds: run it in a thread.

    Args:
        request: the request.
        options: its options.
        forecaster: the requested model.
        catalog: the models, among them the fallback.
        settings: the limits.
        agents: the agents of the request, if they have been read before.
        raster: the map, if the request names it by its digest; it is used as it is, without a copy.

    Raises:
        BadField: the map is invalid.
        BadFields: the call is strict, and an agent cannot be forecast as requested.
    """
    if raster is None:
        raster = read_raster(request, settings)
    if agents is None:
        agents = read_agents(request, settings)
    scene, rows, faults = _build_scene(request, agents, frames_of(forecaster, catalog), raster)
    drafts = []
    for index, agent_id in enumerate(agents.ids):
        if index in faults:
            draft = Draft(index, agent_id, pb.FORECAST_STATUS_INVALID)
            draft.invalidate(faults[index])
            drafts.append(draft)
        elif agents.predict[index] and scene is not None:
            drafts.append(_assign(index, agent_id, scene, rows[index], (forecaster, catalog.fallback)))
    warnings = input_warnings(request, agents, raster)
    plan = Plan(options, agents, forecaster, catalog.fallback, scene, drafts, [], warnings, rows)
    plan.check_strict()
    plan.warnings.extend(_warnings(plan))
    plan.warnings.extend(of_context_agents(warnings, [draft.index for draft in drafts]))
    plan.add_groups(draft for draft in drafts if draft.forecaster is not None)
    return plan


def set_outcomes(groups: Sequence[Group], outcomes: Sequence[Outcome]) -> list[Draft]:
    """Store the outcomes of the groups' jobs, and return the drafts whose forecasts are not finite."""
    return [
        draft for group, outcome in zip(groups, outcomes, strict=True) for draft in group.set_outcome(outcome)
    ]


def frames_of(forecaster: Forecaster, catalog: Catalog) -> int:
    """Return the number of history frames that a call may use."""
    return max(forecaster.info.history_frames, catalog.fallback.info.history_frames)


def _build_scene(
    request: pb.PredictRequest, agents: Agents, frames: int, raster: Raster | None
) -> tuple[Scene | None, dict[int, int], dict[int, Fault]]:
    """Return the usable agents as a scene, their rows in it by request index, and all faults."""
    faults = dict(agents.faults)
    if agents.observations is None:
        return None, {}, faults
    states = resample(agents.observations, request.time, frames)
    observed_now = states.first < states.frames
    kept = observed_now & states.velocity_known
    for row in np.flatnonzero(~kept).tolist():
        index = int(agents.valid[row])
        detail = (
            "a single state needs its velocity, or another state "
            f"{MIN_DIFFERENCE_SPAN} s to {MAX_GAP} s before it"
            if observed_now[row]
            else f"the newest state is more than {MAX_AGE} s old"
        )
        faults.setdefault(index, Fault(f"agents[{index}].states", detail))
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
    """Assign an agent to the first model, or to the second if the first cannot forecast it."""
    forecaster, fallback = models
    observed = scene.states.frames - int(scene.states.first[row])
    draft = Draft(index, agent_id, pb.FORECAST_STATUS_OK, row=row, forecaster=forecaster)
    draft.history_frames = min(observed, forecaster.info.history_frames)
    kind = scene.types[row]
    heading_known = math.isfinite(scene.states.heading[row, -1])
    reason = _unfit(forecaster, kind, heading_known)
    if reason is not None:
        if _unfit(fallback, kind, heading_known) is not None:
            draft.invalidate(Fault(f"agents[{index}].{reason[0]}", reason[1]))
            return draft
        draft.history_frames = observed
        draft.fall_back(fallback, f"agents[{index}].{reason[0]}", reason[1])
    elif draft.history_frames < forecaster.info.history_frames:
        draft.status = pb.FORECAST_STATUS_SHORT_HISTORY
        draft.detail = f"{draft.history_frames} of {forecaster.info.history_frames} frames"
    return draft


def _unfit(forecaster: Forecaster, kind: AgentType, heading_known: bool) -> tuple[str, str] | None:
    """Return why a model cannot forecast an agent: the field at fault and the reason; None if it can."""
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
        # A model may read the map for some agent types only; the others do not miss it
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
