"""The functions of `twin_methods` as methods of both clients."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar, overload

from flexdt.clients.client import twin_methods as m
from flexdt.clients.client.flows import Flow

if TYPE_CHECKING:
    from flexdt.clients.client.async_client import AsyncTwinClient
    from flexdt.clients.client.client import TwinClient

_P = ParamSpec("_P")
_R = TypeVar("_R")


class ClientMethod(Generic[_P, _R]):
    """A method made of a function that makes a flow, with its signature and docstring.

    It runs the flow by its client's `run`: so it blocks on a `TwinClient`, and is a coroutine on an
    `AsyncTwinClient`.
    """

    def __init__(self, make: Callable[_P, Flow[_R]]) -> None:
        @functools.wraps(make)
        def blocking(self: TwinClient, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
            return self.run(make(*args, **kwargs))

        @functools.wraps(make)
        async def awaited(self: AsyncTwinClient, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
            return await self.run(make(*args, **kwargs))

        self._methods: dict[bool, Any] = {False: blocking, True: awaited}
        # What help() and notebooks show: with self, without Flow.
        made = inspect.signature(make)
        own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
        returns = str(made.return_annotation).removeprefix("Flow[").removesuffix("]")
        parameters = [own, *made.parameters.values()]
        for method in self._methods.values():
            method.__signature__ = made.replace(parameters=parameters, return_annotation=returns)

    @overload
    def __get__(self, client: TwinClient, kind: type[TwinClient]) -> Callable[_P, _R]: ...
    @overload
    def __get__(
        self, client: AsyncTwinClient, kind: type[AsyncTwinClient]
    ) -> Callable[_P, Coroutine[Any, Any, _R]]: ...
    def __get__(self, client: TwinClient | AsyncTwinClient | None, kind: type[Any]) -> Any:
        return self._methods[inspect.iscoroutinefunction(kind.run)].__get__(client, kind)


class SharedMethods:
    """The methods of the wire; how they wait is the client's. Written by `make web`."""

    control = ClientMethod(m.control)
    ping = ClientMethod(m.ping)
    discover = ClientMethod(m.discover)
    state = ClientMethod(m.state)
    move = ClientMethod(m.move)
    jog = ClientMethod(m.jog)
    set_axis = ClientMethod(m.set_axis)
    stop = ClientMethod(m.stop)
    estop = ClientMethod(m.estop)
    reset = ClientMethod(m.reset)
    set_clock = ClientMethod(m.set_clock)
    set_tube = ClientMethod(m.set_tube)
    set_camera = ClientMethod(m.set_camera)
    samples = ClientMethod(m.samples)
    set_sample = ClientMethod(m.set_sample)
    sample_mesh = ClientMethod(m.sample_mesh)
    upload_mesh = ClientMethod(m.upload_mesh)
    upload_scene = ClientMethod(m.upload_scene)
    upload_voxels = ClientMethod(m.upload_voxels)
    projection = ClientMethod(m.projection)
    ray = ClientMethod(m.ray)
    geometry = ClientMethod(m.geometry)
    predict_exposure = ClientMethod(m.predict_exposure)
    check_script = ClientMethod(m.check_script)
    submit_script = ClientMethod(m.submit_script)
    check_trajectory = ClientMethod(m.check_trajectory)
    submit_trajectory = ClientMethod(m.submit_trajectory)
    jobs = ClientMethod(m.jobs)
    job_status = ClientMethod(m.job_status)
    pause_job = ClientMethod(m.pause_job)
    resume_job = ClientMethod(m.resume_job)
    step_job = ClientMethod(m.step_job)
    abort_job = ClientMethod(m.abort_job)
    wait_job = ClientMethod(m.wait_job)
    datasets = ClientMethod(m.datasets)
    dataset = ClientMethod(m.dataset)
    dataset_frame = ClientMethod(m.dataset_frame)
    apply_calibration = ClientMethod(m.apply_calibration)
    calibration = ClientMethod(m.calibration)
    calibrations = ClientMethod(m.calibrations)
    revert_calibration = ClientMethod(m.revert_calibration)
    fit_calibration = ClientMethod(m.fit_calibration)
    align_dataset = ClientMethod(m.align_dataset)
    save_scene = ClientMethod(m.save_scene)
    load_scene = ClientMethod(m.load_scene)
