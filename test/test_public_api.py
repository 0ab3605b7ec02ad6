# SPDX-FileCopyrightText: 2026 The dcgs_ros authors
# SPDX-License-Identifier: BSD-3-Clause
"""`from dcgs_ros import ...` gives the objects of their modules, and loads them only then."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

import dcgs_ros

ROOT = Path(__file__).resolve().parent.parent
LoadedAfter = Callable[[str], set[str]]

HEAVY = {'numpy', 'cv2', 'numba', 'scipy', 'yaml', 'tyro', 'tqdm', 'matplotlib', 'rclpy'}
NAMES = [name for name in dcgs_ros.__all__ if name != '__version__']


def typed_imports() -> dict[str, str]:
    """Return the module of each name that type checkers see imported."""
    tree = ast.parse(Path(dcgs_ros.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level]
    return {alias.asname or '': node.module or '' for node in imports for alias in node.names}


@pytest.mark.parametrize('name', NAMES)
def test_a_name_is_the_object_of_its_home_module(name: str) -> None:
    home = import_module(f'dcgs_ros.{typed_imports()[name]}')
    value = getattr(dcgs_ros, name)
    assert value is getattr(home, name)
    # Defined there, or in a module of that package; not passed on from elsewhere.
    assert value.__module__.startswith(home.__name__)


def test_type_checkers_see_the_same_names_from_the_same_modules() -> None:
    assert typed_imports() == dcgs_ros._HOMES
    assert sorted(NAMES) == sorted(dcgs_ros._HOMES)


def test_importing_the_package_loads_nothing_heavy(loaded_after: LoadedAfter) -> None:
    assert not loaded_after('import dcgs_ros; dir(dcgs_ros)') & HEAVY


def test_a_name_loads_its_module_only(loaded_after: LoadedAfter) -> None:
    loaded = loaded_after('from dcgs_ros import Trajectory')
    assert 'numpy' in loaded
    assert not loaded & {'cv2', 'numba'}


def test_names_are_listed_before_their_first_use(loaded_after: LoadedAfter) -> None:
    code = 'import dcgs_ros; assert set(dcgs_ros.__all__) <= set(dir(dcgs_ros))'
    assert 'dcgs_ros.core' not in loaded_after(code)


def test_a_star_import_gives_all_names() -> None:
    names: dict[str, object] = {}
    exec('from dcgs_ros import *', names)
    assert set(dcgs_ros.__all__) <= set(names)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'dcgs_ros' has no attribute 'Slam'"):
        _ = dcgs_ros.Slam  # type: ignore[attr-defined]
    with pytest.raises(ImportError):
        exec('from dcgs_ros import Slam')


@pytest.mark.slow
def test_the_example_of_the_readme_runs() -> None:
    text = (ROOT / 'README.md').read_text()
    (code,) = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
    assert "'synthetic:room'" in code
    code = code.replace("'synthetic:room'", "'synthetic:room?frames=5'")
    check = 'assert color.shape == (3, 480, 640) and mapper.steps > 0'
    subprocess.run([sys.executable, '-c', f'{code}\n{check}'], cwd=ROOT, check=True)
