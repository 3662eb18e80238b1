"""Calls a ROS 1 service and returns its response."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from amberbox.blackbox.sources.ros1.deadline import Deadline, RosStoppedError
from amberbox.blackbox.sources.ros1.master import global_name
from amberbox.blackbox.sources.ros1.message_type import service_type
from amberbox.blackbox.sources.ros1.service_client import call_service, probe_service
from amberbox.core.config import Finding
from amberbox.core.contracts import ActionContext
from amberbox.core.errors import AmberboxError, NotStartedError, UsageError
from amberbox.core.options import option
from amberbox.experiments.actions import _placeholders
from amberbox.experiments.actions._ros1 import (
    RosPeerOptions,
    check_expected,
    node_settings,
    plain,
    simulate,
    unfit_message,
    unfit_name,
)

SAMPLE = """\
reset_odometry:
  description: Set the odometry to zero
  kind: ros1_service
  service: /reset_odometry
  type: std_srvs/Trigger
  expect: {success: true}
  simulated: {success: true, message: reset}
  risk: state
  timeout: 10 s
"""


@dataclass(frozen=True)
class ServiceStop:
    """The call that stops the robot."""

    request: Mapping[str, Any] = option({}, "fields of its request; those left out are zero")
    service: str = option("", "the service, if it is another one")
    type: str = option("", "its type, if the service is another one; told by it when absent")
    definition: str = option("", "text of its type: request, ---, response")
    expect: Mapping[str, Any] = option({}, "values that its response must have")


@dataclass(frozen=True, kw_only=True)
class Config(RosPeerOptions):
    """Which service is called, with what."""

    service: str = option(doc="service to call")
    type: str = option("", "its type, as in `std_srvs/Trigger`; the service tells it when absent")
    request: Mapping[str, Any] = option({}, 'fields; "{name}" is the value of a parameter')
    definition: str = option("", "text of the type: request, ---, response; std_srvs are known")
    expect: Mapping[str, Any] = option({}, "values that the response must have, or it has failed")
    answer_within: float = option(5.0, "longest wait for the response", unit="s")
    safe_stop: ServiceStop | None = option(None, "call that stops the robot")

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield what is wrong with the values."""
        yield from super().check()
        yield from unfit_name("service", self.service, "service")
        if not 0 < self.answer_within <= 3600:
            yield "answer_within", "must be above 0 and at most 3600 s"
        if self.definition and not self.type:
            yield "type", "is missing: the definition is that of a type"
        for key, call in self.calls():
            if call.service:
                yield from unfit_name(key, call.service, "service")
            if call.type:
                try:
                    service_type(call.type, call.definition)
                except UsageError as error:
                    yield key, f"{error.what}; {error.hint}" if error.hint else error.what

    def calls(self) -> Iterator[tuple[str, ServiceStop]]:
        """Yield the call, and the one that stops it, with the keys of what may be wrong in them."""
        yield (
            "type",
            ServiceStop(self.request, self.service, self.type, self.definition, self.expect),
        )
        stop = self.safe_stop
        if stop is not None and stop.service:
            yield "safe_stop", stop
        elif stop is not None:
            yield (
                "safe_stop",
                ServiceStop(stop.request, self.service, self.type, self.definition, stop.expect),
            )


def problems(config: Config, parameters: Collection[str]) -> Iterator[Finding]:
    """Yield placeholders without a parameter, parameters without an effect, and unfit requests."""
    templates: dict[str, Any] = {"request": config.request, "simulated": config.simulated}
    if config.safe_stop is not None:
        templates["safe_stop"] = config.safe_stop.request
    yield from _placeholders.problems(templates, parameters, "request")
    for key, call in config.calls():
        if call.type:
            kind = service_type(call.type, call.definition).request
            yield from unfit_message("request" if key == "type" else key, kind, call.request)


def run(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Call the service and return its response; a call that was sent cannot be taken back."""
    _, call = next(config.calls())
    sent: list[bool] = []
    try:
        return _call(config, call, context, lambda: sent.append(True))
    except RosStoppedError:
        return None
    except AmberboxError as error:
        if sent:
            raise
        raise NotStartedError(error.what, error.hint) from error


def safe_stop(config: Config, context: ActionContext) -> None:
    """Call the service that stops the robot."""
    for key, call in config.calls():
        if key == "safe_stop":
            _call(config, call, context, lambda: None)


def simulated(config: Config, context: ActionContext) -> Mapping[str, Any] | None:
    """Call nothing."""
    return simulate(config, context)


def _call(
    config: Config, call: ServiceStop, context: ActionContext, sending: Callable[[], None]
) -> dict[str, Any]:
    name = global_name(call.service)
    settings = node_settings(config, name)
    deadline = Deadline.within(config.connect_within, context.stopped)
    type_name = call.type or probe_service(name, settings, deadline).type
    kind = service_type(type_name, call.definition)
    request = kind.request.encode(_placeholders.filled(call.request, context.parameters))
    answering = Deadline.within(config.answer_within, context.stopped)
    answer: dict[str, Any] = plain(call_service(name, kind, request, settings, answering, sending))
    check_expected(call.expect, answer, name)
    return answer
