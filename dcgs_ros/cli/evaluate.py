# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`dcgs evaluate`: two trajectory files against each other."""

from __future__ import annotations

import json

from ..evaluation.report import accuracy_report, assess
from ..evaluation.trajectory import EvaluationError
from ..io.trajectory import read_tum
from .arguments import EvaluateArguments
from .summary import accuracy_rows, table


def execute(arguments: EvaluateArguments) -> int:
    """Print ATE and RPE; without an ATE there is nothing to print."""
    estimate, truth = read_tum(arguments.trajectory), read_tum(arguments.groundtruth)
    accuracy = assess(estimate, truth)
    if accuracy.ate is None:
        raise EvaluationError(accuracy.why_no_ate)
    if arguments.json:
        counts = {'poses': accuracy.ate.poses, 'matched': accuracy.ate.matched}
        print(json.dumps(counts | accuracy_report(accuracy), indent=2, allow_nan=False))
    else:
        print(
            table(
                f'{arguments.trajectory} against {arguments.groundtruth}', accuracy_rows(accuracy)
            )
        )
    return 0
