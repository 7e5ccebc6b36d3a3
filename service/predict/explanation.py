"""One Explain call from top to bottom: decode, validate, plan, ask, forecast while the model is free, encode.

An explanation takes some hundred forecasts, so it never stands in the queue of the calls of Predict: its
forwards run while nothing waits for the model, a few agents at a time, as those of the shadow model do. One
explanation is worked on at a time; a few more may wait, the others are refused.
"""

import asyncio
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np

from cab.forecast.v1 import explanation_service_pb2 as pb
from cab.forecast.v1 import prediction_service_pb2 as predict_pb
from cab.forecast.v1.bounds import MAX_DRAWS, MAX_PERMUTATIONS
from model.arrays import Floats
from model.explanation.donors import Donors
from model.explanation.question import (
    PARTS,
    Explanation,
    ExplanationSettings,
    Part,
    ShapleyValue,
    ask,
    end_points,
    forecasts_needed,
)
from model.forecaster import Context, Forecaster, Prepared
from model.scenes.scene import STEP_SECONDS, AgentType, Scene
from service.access.caller import Grant
from service.errors import BadField, Fault, Overloaded, TooLarge
from service.lifecycle import Lifecycle
from service.predict.admission import Call
from service.predict.batcher import Batcher, Job
from service.predict.catalog import Catalog, reference
from service.predict.plan import Draft, Plan, make_plan
from service.predict.rasters.library import RasterLibrary
from service.predict.request import read_options
from service.predict.request_reader import EncodedRequest, RequestReader
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.telemetry.tracing import span

_T = TypeVar("_T")
MAX_WAITING: Final = 8
"""Maximum number of calls that wait while another one is worked on."""
_RETRY_AFTER: Final = 1.0
_DRAWS: Final = 8
_PERMUTATIONS: Final = 16
_BASELINES: Final = frozenset(pb.ExplanationBaseline.values())
_NO_DONORS: Final = "the server has no donors beside its models: the null context stands for what is absent"


@dataclass(frozen=True)
class _Asked:
    """Validated options of a call."""

    settings: ExplanationSettings
    warnings: list[str]


@dataclass
class _Answer:
    """An agent of the response: its explanation, and the indices of the request's agents by row."""

    explanation: Explanation | None = None
    forecasts: int = 0


class Explainer:
    """Stages of an Explain call. Used on one event loop; what may take milliseconds runs in threads."""

    catalog: Catalog
    """Models that calls begin with; set before the lifecycle becomes ready, and by reloads."""

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        lifecycle: Lifecycle,
        batcher: Batcher,
        rasters: RasterLibrary,
        threads: Executor,
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._lifecycle = lifecycle
        self._batcher = batcher
        self._rasters = rasters
        self._threads = threads
        self._reader = RequestReader(threads)
        self._turn = asyncio.Lock()
        self._calls = 0

    @contextmanager
    def accept(self, timeout: float | None = None, grant: Grant | None = None) -> Iterator[Call]:
        """Accept a call on its arrival, before its body is read; a drain waits for the end of the block.

        Args:
            timeout: the client's timeout, s; the server's own limit applies as well.
            grant: counts the agents of the request against the limits of the caller's key; None: there are
                no limits.

        Raises:
            Unavailable: the server is not ready.
            Overloaded: too many calls wait already.
        """
        self._lifecycle.require_ready()
        if self._calls > MAX_WAITING:
            raise Overloaded(f"{self._calls - 1} explanations are waiting already", _RETRY_AFTER)
        limit = self._settings.max_timeout
        call = Call(asyncio.get_running_loop().time() + (limit if timeout is None else min(timeout, limit)))
        if grant is not None:
            call.caller, call.grant = grant.caller.name, grant
        self._calls += 1
        try:
            with self._lifecycle.in_progress():
                yield call
        finally:
            self._calls -= 1

    async def explain(
        self, request: pb.ExplainRequest | EncodedRequest[pb.ExplainRequest], call: Call | None = None
    ) -> pb.ExplainResponse:
        """Explain the forecasts of agents of a scene.

        Args:
            request: the request.
            call: the accepted call; None: it is accepted here.

        Raises:
            ServiceError: the call fails.
        """
        if call is None:
            with self.accept() as accepted:
                return await self.explain(request, accepted)
        async with call.in_time():
            message = await self._reader.read(request) if isinstance(request, EncodedRequest) else request
            if call.grant is not None:
                call.grant.charge(len(message.agents))
            catalog = self.catalog  # of the whole call, even if other models take over meanwhile
            forecaster = catalog.get(message.model, call.caller)
            asked = _read_options(message.options, catalog.donors)
            scene = _as_predict_request(message)
            options = read_options(scene, forecaster.info, self._settings)
            if options.predicted > self._settings.max_explained_agents:
                raise TooLarge(
                    f"{options.predicted} agents to explain; at most {self._settings.max_explained_agents} "
                    "are accepted (predict = false makes an agent a neighbour only)"
                )
            async with self._turn:
                raster = await self._rasters.find(message.scene_raster, call.remaining())
                plan = await self._in_thread(
                    make_plan, scene, options, forecaster, catalog, self._settings, None, raster
                )
                await self._in_thread(self._check_size, plan, asked.settings)
                with span("explain"):
                    answers = {draft.index: await self._explain(plan, draft, asked) for draft in plan.drafts}
            return await self._in_thread(_encode, plan, answers, asked)

    def _check_size(self, plan: Plan, settings: ExplanationSettings) -> None:
        """Refuse a call that takes too many forecasts.

        Raises:
            BadField: it does.
        """
        limit = self._settings.max_explanation_forecasts
        needed = 0
        for draft in plan.drafts:
            if plan.scene is not None and draft.forecaster is not None:
                seen = draft.forecaster.sees(_seen_by(draft.forecaster, plan.scene), np.array([draft.row]))
                needed += forecasts_needed(int(seen.sum()), settings)
        if needed > limit:
            field = "options.permutations" if settings.by_neighbor else "options.draws"
            raise BadField(
                field,
                f"with so many the explanations take {needed} forecasts, and at most {limit} are made; "
                "lessen it, or ask for fewer agents at a time",
            )

    async def _explain(self, plan: Plan, draft: Draft, asked: _Asked) -> _Answer:
        """Explain the forecast of one agent."""
        scene, forecaster = plan.scene, draft.forecaster
        if scene is None or forecaster is None:
            return _Answer()
        question = await self._in_thread(
            ask, forecaster, _seen_by(forecaster, scene), draft.row, asked.settings
        )
        points = await self._end_points(
            forecaster, scene.types[draft.row], question.inputs, plan.options.steps
        )
        if not np.isfinite(points).all():
            draft.invalidate(
                Fault(f"agents[{draft.index}]", f"a forecast of {forecaster.info.name} was not finite")
            )
            return _Answer(None, len(points))
        return _Answer(await self._in_thread(question.answer, points), len(points))

    async def _end_points(
        self, forecaster: Forecaster, kind: AgentType, inputs: Prepared, steps: int
    ) -> Floats:
        """Return where the most likely modes of forecasts end, which are made while the model is free."""
        job = Job(forecaster, kind, Context.FULL, inputs, steps)
        points = []
        for part in self._batcher.spare_parts(job):
            await self._batcher.until_free()
            outcome = await self._batcher.run_spare(part)
            self._metrics.inference.labels(forecaster.info.name).observe(outcome.inference)
            points.append(end_points(outcome.mixture))
        return np.concatenate(points)

    async def _in_thread(self, function: Callable[..., _T], *arguments: object) -> _T:
        return await asyncio.get_running_loop().run_in_executor(
            self._threads, functools.partial(function, *arguments)
        )


def _seen_by(forecaster: Forecaster, scene: Scene) -> Scene:
    """Return a scene with as many frames as a model uses."""
    return replace(scene, states=scene.states.last_frames(forecaster.info.history_frames))


def _as_predict_request(request: pb.ExplainRequest) -> predict_pb.PredictRequest:
    """Return a request of forecasts about the same scene."""
    scene = predict_pb.PredictRequest(model=request.model, agents=request.agents)
    if request.HasField("time"):
        scene.time = request.time
    if request.HasField("scene_raster"):
        scene.scene_raster.CopyFrom(request.scene_raster)
    if request.options.HasField("horizon"):
        scene.options.horizon = request.options.horizon
    return scene


def _read_options(options: pb.ExplainOptions, donors: Donors | None) -> _Asked:
    """Validate the options that only explanations have.

    Raises:
        BadField: an option is out of its bounds.
    """
    if options.baseline not in _BASELINES:
        raise BadField("options.baseline", f"unknown value {options.baseline}")
    if options.draws == 1 or options.draws > MAX_DRAWS:
        raise BadField("options.draws", f"must be 0, or 2 to {MAX_DRAWS}")
    if options.permutations % 2 or options.permutations == 2 or options.permutations > MAX_PERMUTATIONS:
        raise BadField("options.permutations", f"must be 0, or an even number from 4 to {MAX_PERMUTATIONS}")
    warnings = []
    if options.baseline == pb.EXPLANATION_BASELINE_NULL_CONTEXT:
        donors = None
    elif donors is None:
        warnings.append(_NO_DONORS)
    settings = ExplanationSettings(
        donors,
        options.draws or _DRAWS,
        options.by_neighbor,
        options.permutations or _PERMUTATIONS,
        options.seed,
    )
    return _Asked(settings, warnings)


def _encode(plan: Plan, answers: dict[int, _Answer], asked: _Asked) -> pb.ExplainResponse:
    response = pb.ExplainResponse(
        model=reference(plan.forecaster.info),
        time=plan.options.time,
        horizon=plan.options.steps * STEP_SECONDS,
        forecasts=sum(answer.forecasts for answer in answers.values()),
        warnings=[*asked.warnings, *plan.warnings],
    )
    # Rows of the scene are the usable agents of the request, in order
    for draft in plan.drafts:
        message = response.explanations.add(agent_id=draft.agent_id, status=draft.status, detail=draft.detail)
        if draft.status == predict_pb.FORECAST_STATUS_INVALID:
            message.field = draft.field
        if draft.forecaster is not None:
            message.model.CopyFrom(reference(draft.forecaster.info))
        explanation = answers[draft.index].explanation
        if explanation is not None:
            _fill(message, explanation, plan)
    return response


def _fill(message: pb.AgentExplanation, explanation: Explanation, plan: Plan) -> None:
    message.draws = explanation.draws
    message.permutations = explanation.permutations
    message.baseline = (
        pb.EXPLANATION_BASELINE_DONORS if explanation.draws else pb.EXPLANATION_BASELINE_NULL_CONTEXT
    )
    for position, point in (
        (message.end_point, explanation.end_point),
        (message.base_point, explanation.base_point),
    ):
        position.x, position.y = point.tolist()
    values = {Part.STATE: message.state, Part.MAP: message.map, Part.NEIGHBORS: message.neighbors}
    for part in PARTS:
        _set(values[part], explanation.parts[part])
    ranked = sorted(explanation.by_neighbor.items(), key=lambda item: (-abs(item[1].value[0]), item[0]))
    for row, value in ranked:
        neighbor = message.by_neighbor.add(agent_id=plan.ids[row])
        _set(neighbor.value, value)


def _set(message: pb.ShapleyValue, value: ShapleyValue) -> None:
    message.nearer, message.ahead, message.left = value.value.tolist()
    message.nearer_error, message.ahead_error, message.left_error = value.error.tolist()
