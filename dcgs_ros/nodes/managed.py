# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""A node with a lifecycle: nav2's lifecycle manager, or `ros2 lifecycle`, starts and stops it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from .health import Level, Verdict

UNCONFIGURED = Verdict(Level.WARN, 'not configured: set node.autostart, or configure it')
INACTIVE = Verdict(Level.WARN, 'not active: activate the node')
_DONE, _FAILED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class ManagedNode(LifecycleNode):
    """Puts the transitions down to `configure`, `activate`, `deactivate` and `end`.

    Parameters and diagnostics are there in every state; what `configure` advertises and subscribes
    to is gone after a clean-up.
    """

    def __init__(self, name: str) -> None:
        """Begin unconfigured."""
        super().__init__(name)
        self.configured = self.active = False
        self._ready = False  # whether its thread has loaded the kernels
        self._lasting: set[Any] = set()  # publishers and such that do not come from `configure`
        self._failure: Exception | None = None
        self._tells = True  # whether a failure goes to the log

    def configure(self) -> None:
        """Advertise, subscribe, start the threads."""
        raise NotImplementedError

    def activate(self) -> None:
        """Begin to work."""
        raise NotImplementedError

    def deactivate(self) -> None:
        """Do no work until `activate`, without forgetting any."""
        raise NotImplementedError

    def end(self) -> None:
        """End what `configure` began."""
        raise NotImplementedError

    def autostart(self) -> None:
        """Configure and activate; raise what `configure` raises."""
        self._tells = False
        self.trigger_configure()
        self._tells = True
        if self._failure is not None:
            raise self._failure
        self.trigger_activate()

    def close(self) -> None:
        """End, at the end of the process too."""
        if self.configured:
            self.configured = self.active = False
            self.end()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure; where that raises, stay as it was."""
        self._lasting, self._failure = {entity for entity, _ in self._entities()}, None
        try:
            self.configure()
        except Exception as error:  # rclpy would hide it
            self._failure = error
            if self._tells:
                self.get_logger().error(f'not configured: {error}')
            self._destroy_others()
            return _FAILED
        self.configured = True
        return _DONE

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate."""
        self.active = True
        self.activate()
        return _DONE

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate."""
        self.active = False
        self.deactivate()
        return _DONE

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End, and be as before `configure`; not while kernels are loaded, which nothing stops."""
        if not self._ready:
            self.get_logger().error('not cleaned up: it is still loading the kernels')
            return _FAILED
        self.close()
        self._ready = False
        self._destroy_others()
        return _DONE

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End."""
        self.close()
        return _DONE

    def _entities(self) -> Iterator[tuple[Any, Callable[[Any], bool]]]:
        """Yield all that a node may have, and how each is destroyed."""
        for entities, destroy in (
            (self.publishers, self.destroy_publisher),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.clients, self.destroy_client),
            (self.timers, self.destroy_timer),
        ):
            for entity in list(entities):
                yield entity, destroy

    def _destroy_others(self) -> None:
        """Destroy what is not lasting."""
        for entity, destroy in self._entities():
            if entity not in self._lasting:
                destroy(entity)
