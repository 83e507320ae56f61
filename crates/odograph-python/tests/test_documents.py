"""The stub says what the module has, and the guide runs as written."""

import ast
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import odograph as od

HERE = Path(__file__).resolve().parent


def stub():
    return ast.parse((HERE.parent / "odograph.pyi").read_text(encoding="utf-8")).body


def arguments(function):
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    return [argument.arg for argument in named if argument.arg != "self"]


def at_run_time(function):
    return [name for name in inspect.signature(function).parameters if name != "self"]


def test_the_stub_has_every_name_and_argument():
    described = {item.name: item for item in stub() if isinstance(item, ast.ClassDef | ast.FunctionDef)}
    public = {name for name in dir(od) if not name.startswith("_") and name != "odograph"}
    assert {name for name in described if not name.startswith("_")} == public
    for name in public:
        item, real = described[name], getattr(od, name)
        assert real.__doc__, name
        if isinstance(item, ast.FunctionDef):
            assert arguments(item) == at_run_time(real), name
        elif not issubclass(real, Exception):
            methods = {part.name: part for part in item.body if isinstance(part, ast.FunctionDef)}
            there = {part for part in vars(real) if not part.startswith("_")}
            assert {part for part in methods if not part.startswith("_")} == there, name
            for part in there:
                assert getattr(real, part).__doc__, (name, part)
                if callable(getattr(real, part)):
                    assert arguments(methods[part]) == at_run_time(getattr(real, part)), (name, part)
            if "__init__" in methods:
                assert arguments(methods["__init__"]) == at_run_time(real), name


def test_the_package_is_typed():
    installed = Path(od.__file__).parent
    assert (installed / "py.typed").exists() and list(installed.glob("*.pyi"))


def test_the_guide_runs_as_written(tmp_path):
    guide = HERE.parents[2] / "docs" / "python.md"
    examples = re.findall(r"^```python\n(.*?)^```$", guide.read_text(encoding="utf-8"), re.M | re.S)
    assert examples
    script = tmp_path / "guide.py"
    script.write_text("\n".join(examples), encoding="utf-8")
    ran = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=os.environ, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stderr
