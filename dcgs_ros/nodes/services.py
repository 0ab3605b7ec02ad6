# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""Services that are answered when another thread has done the work."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from ..core.errors import DcgsError


def offer(node: Node, name: str, begin: Callable[[], Future[str]]) -> None:
    """Offer a Trigger service; its answer is the text, or the `DcgsError`, of what `begin` began.

    The executor does not wait: diagnostics, images and other services go on meanwhile.
    """
    service = node.create_service(Trigger, name, lambda _, response: begin())
    # rclpy sends what the callback returns at once: here that is a future.
    send = service.send_response

    def send_done(done: Future[str], header: Any) -> None:
        try:
            send(_response(done), header)
        except Exception as error:  # the caller has gone, or ROS: the thread goes on
            if node.context.ok():
                node.get_logger().warning(f'{name} could not be answered: {error}')

    def send_when_done(future: Future[str], header: Any) -> None:
        future.add_done_callback(lambda done: send_done(done, header))

    service.send_response = send_when_done  # type: ignore[method-assign, assignment]


def answered(text: str) -> Future[str]:
    """Return a future that is done already."""
    future: Future[str] = Future()
    future.set_result(text)
    return future


def refused(reason: str) -> Future[str]:
    """Return a future that has failed already."""
    future: Future[str] = Future()
    future.set_exception(DcgsError(reason))
    return future


def _response(done: Future[str]) -> Trigger.Response:
    error = done.exception()
    message = str(error) if error is not None else done.result()
    return Trigger.Response(success=error is None, message=message)
