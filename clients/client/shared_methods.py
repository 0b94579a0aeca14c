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


class Method(Generic[_P, _R]):
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

    control = Method(m.control)
    ping = Method(m.ping)
    discover = Method(m.discover)
    state = Method(m.state)
    move = Method(m.move)
    jog = Method(m.jog)
    set_axis = Method(m.set_axis)
    stop = Method(m.stop)
    estop = Method(m.estop)
    reset = Method(m.reset)
    set_clock = Method(m.set_clock)
    set_tube = Method(m.set_tube)
    set_camera = Method(m.set_camera)
    samples = Method(m.samples)
    set_sample = Method(m.set_sample)
    sample_mesh = Method(m.sample_mesh)
    upload_mesh = Method(m.upload_mesh)
    upload_scene = Method(m.upload_scene)
    upload_voxels = Method(m.upload_voxels)
    projection = Method(m.projection)
    ray = Method(m.ray)
    geometry = Method(m.geometry)
    predict_exposure = Method(m.predict_exposure)
    check_script = Method(m.check_script)
    submit_script = Method(m.submit_script)
    check_trajectory = Method(m.check_trajectory)
    submit_trajectory = Method(m.submit_trajectory)
    jobs = Method(m.jobs)
    job_status = Method(m.job_status)
    pause_job = Method(m.pause_job)
    resume_job = Method(m.resume_job)
    step_job = Method(m.step_job)
    abort_job = Method(m.abort_job)
    wait_job = Method(m.wait_job)
    datasets = Method(m.datasets)
    dataset = Method(m.dataset)
    dataset_frame = Method(m.dataset_frame)
    apply_calibration = Method(m.apply_calibration)
    calibration = Method(m.calibration)
    calibrations = Method(m.calibrations)
    revert_calibration = Method(m.revert_calibration)
    fit_calibration = Method(m.fit_calibration)
    align_dataset = Method(m.align_dataset)
    save_scene = Method(m.save_scene)
    load_scene = Method(m.load_scene)
