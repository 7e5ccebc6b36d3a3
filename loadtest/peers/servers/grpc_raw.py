"""grpc.aio with one lock that is given our requests: the service's own steps, one call after the other.

The difference to the service is what it does between these steps: admission, a queue, batches, deadlines,
track memory and metrics.
"""

import asyncio
import time

import grpc
import torch
from grpc import aio

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.routes import PREDICT
from loadtest.peers.network import HOST, ServedModel
from model.forecaster import complete
from model.registry import Registry
from service.predict.batcher import Outcome
from service.predict.catalog import build_catalog
from service.predict.encode import encode
from service.predict.plan import make_plan, set_outcomes
from service.predict.request import read_options
from service.predict.request_reader import RequestLimits, read_protobuf
from service.settings import Settings


class Predict:
    """A Predict call from the body of its request to that of its response, in one thread.

    Args:
        served: the model.
    """

    def __init__(self, served: ServedModel) -> None:
        self._settings = Settings(models=served.models, threads=served.threads)
        self._limits = RequestLimits.from_settings(self._settings)
        registry = Registry.load(served.models)
        forecaster = registry.get(served.model)
        if served.engine != "eager" and forecaster.compile(served.threads or torch.get_num_threads()):
            torch.set_num_threads(1)
        self._catalog = build_catalog(registry, served.model)

    def __call__(self, body: bytes) -> bytes:
        """Return the body of the response."""
        request = read_protobuf(pb.PredictRequest, body, self._limits)
        forecaster = self._catalog.get(request.model)
        options = read_options(request, forecaster.info, self._settings)
        plan = make_plan(request, options, forecaster, self._catalog, self._settings)
        outcomes = []
        for job in (group.job for group in plan.groups):
            begin = time.perf_counter()
            mixture = job.forecaster.forecast(complete([job.inputs]), job.agent_type, job.context, job.steps)
            outcomes.append(Outcome(mixture, 0.0, time.perf_counter() - begin, job.agents))
        set_outcomes(plan.groups, outcomes)
        return encode(plan, seed=0).SerializeToString()


async def main(served: ServedModel) -> None:
    """Serve until the process is terminated."""
    call, lock = Predict(served), asyncio.Lock()

    async def predict(body: bytes, _: object) -> bytes:
        async with lock:
            return await asyncio.to_thread(call, body)

    server = aio.server(
        options=[("grpc.max_receive_message_length", -1), ("grpc.max_send_message_length", -1)]
    )
    methods = {PREDICT.method: grpc.unary_unary_rpc_method_handler(predict)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(PREDICT.service, methods),))
    server.add_insecure_port(f"{HOST}:{served.port}")
    await server.start()
    await server.wait_for_termination()


if __name__ == "__main__":
    asyncio.run(main(ServedModel.from_flags()))
