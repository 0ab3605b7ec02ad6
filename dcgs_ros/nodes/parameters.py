# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings as ROS parameters, declared, described and checked from the dataclasses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from difflib import get_close_matches
from typing import Any, Generic

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from ..core.config.nodes import MapperSettings, ReplaySettings, TrackerSettings
from ..core.config.schema import ConfigError, S, Setting, override, settings
from ..core.errors import DcgsError

NODES = (TrackerSettings(), MapperSettings(), ReplaySettings())  # a file may be for all of them

_AUTO = 'auto'  # stands for None, which a parameter cannot be
_OF_ROS = 'qos_overrides.'  # parameters that rclpy declares later
_ALIKE = 0.8  # of two names, 1 for equal ones; less may be a parameter of another package


class Parameters(Generic[S]):
    """Keeps a node's settings and its parameters equal."""

    def __init__(
        self,
        node: Node,
        defaults: S,
        live: Callable[[str], bool],
        on_change: Callable[[S], None],
    ) -> None:
        """Declare every setting, with its value from files and the command line.

        Settings whose key is `live` may change at run time: `on_change` gets the settings after
        each request. Those of the other nodes are accepted and ignored, since a file may be for
        all. Raises `ConfigError` for an unusable value, and for a name that is nearly right.
        """
        given = _given(node, defaults)
        self.settings = override(defaults, given)
        self._all = {setting.key: setting for setting in settings(self.settings)}
        self._on_change = on_change
        for key, setting in self._all.items():
            node.declare_parameter(
                key, _sent(setting.value), _descriptor(setting, live(key)), ignore_override=True
            )
        node.add_pre_set_parameters_callback(self._fit)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)

    def _fit(self, parameters: list[Parameter]) -> list[Parameter]:
        """Accept 2 for 2.0, which ROS refuses for a parameter of another type."""
        return [self._fitted(parameter) for parameter in parameters]

    def _fitted(self, parameter: Parameter) -> Parameter:
        setting = self._all.get(parameter.name)
        if setting is None or setting.kind is not float:
            return parameter
        if parameter.type_ is not Parameter.Type.INTEGER:
            return parameter
        return Parameter(parameter.name, value=float(parameter.value))

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Accept all parameters of a request, or none."""
        for parameter in parameters:
            if parameter.name in self._all and parameter.type_ is Parameter.Type.NOT_SET:
                return SetParametersResult(
                    successful=False, reason=f'{parameter.name} is a setting: it stays'
                )
        try:
            self._changed(parameters)
        except DcgsError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        """Take over what was accepted."""
        after = self._changed(parameters)
        if after != self.settings:
            self.settings = after
            self._on_change(after)

    def _changed(self, parameters: list[Parameter]) -> S:
        values = {p.name: p.value for p in parameters if p.name in self._all}
        return override(self.settings, values)


def _given(node: Node, defaults: Any) -> dict[str, Any]:
    """Return the settings given by files and command line."""
    # rclpy has no public access to parameters that were given but not declared.
    overrides: Mapping[str, Parameter] = node._parameter_overrides
    known = {setting.key: setting for setting in settings(defaults)}
    others = _of_other_nodes(known)
    unknown = sorted(
        k for k in overrides.keys() - known.keys() - others.keys()
        if not node.has_parameter(k) and not k.startswith(_OF_ROS)
    )  # fmt: skip
    valid = known | others
    told = [_with_nearest(key, valid) for key in unknown]
    wrong = [text for key, text in zip(unknown, told, strict=True) if _is_mistake(key, valid)]
    if wrong:
        raise ConfigError(f'{node.get_name()}: unknown parameters: {", ".join(wrong)}')
    if unknown:  # no error: they may be another package's
        node.get_logger().warning(f'unknown parameters are ignored: {", ".join(told)}')
    return {
        key: p.value for key, p in overrides.items()
        if key in known and not _is_for_another(p.value, known[key], others.get(key))
    }  # fmt: skip


def _of_other_nodes(known: Mapping[str, Setting]) -> dict[str, Setting]:
    """Return settings of the other nodes, where they differ from the `known` ones of a node.

    A name without a stage that the node has in one is not among them: it is the node's own.
    """
    own = {key.rpartition('.')[2] for key in known if '.' in key}
    every = [s for defaults in NODES for s in settings(defaults) if s.key not in own]
    return {s.key: s for s in every if s.key not in known or s.kind is not known[s.key].kind}


def _is_for_another(value: Any, setting: Setting, other: Setting | None) -> bool:
    """Return whether a value of a name that two nodes have is only of the type of the other's."""
    return other is not None and type(value) is other.kind is not setting.kind


def _with_nearest(key: str, valid: Collection[str]) -> str:
    """Return a name with the valid ones of the same last part, else with the nearest."""
    same = [k for k in valid if k.rpartition('.')[2] == key.rpartition('.')[2]]
    near = same or get_close_matches(key, valid, 1)
    return f'{key} (meant is {" or ".join(near)}?)' if near else key


def _is_mistake(key: str, valid: Collection[str]) -> bool:
    """Return whether a name can only be one of ours, by its stage, its last part, or nearly."""
    stage, _, name = key.partition('.')
    stages = {k.partition('.')[0] for k in valid if '.' in k}
    names = {k.rpartition('.')[2] for k in valid}
    return bool(stage in stages if name else key in names) or bool(
        get_close_matches(key, valid, 1, _ALIKE)
    )


def _descriptor(setting: Setting, live: bool) -> ParameterDescriptor:
    """Return the description that `ros2 param describe` shows."""
    descriptor = ParameterDescriptor(
        description=setting.doc,
        read_only=not live,
        dynamic_typing=setting.optional,
        additional_constraints=_constraints(setting),
    )
    if setting.range is not None:
        low, high = setting.range
        if setting.kind is int:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
    return descriptor


def _constraints(setting: Setting) -> str:
    if setting.choices:
        return f'one of {", ".join(setting.choices)}'
    return f'a number or {_AUTO}' if setting.optional else ''


def _sent(value: Any) -> Any:
    return _AUTO if value is None else value
