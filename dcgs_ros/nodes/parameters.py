# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Settings as ROS parameters, declared, described and checked from the dataclasses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Generic

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from ..core.config.schema import ConfigError, S, Setting, flatten, override, settings
from ..core.errors import DcgsError

_AUTO = 'auto'  # stands for None, which a parameter cannot be


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
        each request. Raises `ConfigError` for an unusable value, and for an unknown name within
        a stage.
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
    known = flatten(defaults)
    stages = {f.name for f in dataclasses.fields(defaults)} - known.keys()
    unknown = [k for k in overrides if k not in known and k.split('.')[0] in stages]
    if unknown:
        of_stages = [k for k in known if k.split('.')[0] in {u.split('.')[0] for u in unknown}]
        raise ConfigError(
            f'{node.get_name()}: unknown parameters {", ".join(sorted(unknown))}; the valid ones '
            f'of these stages are {", ".join(of_stages)}'
        )
    strange = [
        k for k in overrides if k not in known and '.' not in k and not node.has_parameter(k)
    ]
    if strange:  # no error: a file may be for all nodes
        node.get_logger().warning(f'unknown parameters {", ".join(sorted(strange))} are ignored')
    return {key: p.value for key, p in overrides.items() if key in known}


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
