#!/usr/bin/env python3
"""What each tuned number and each branch of the tracker is worth.

    python3 bench/ablation.py build             # an instrumented copy of the library and the gate
    python3 bench/ablation.py measure OUT.jsonl # appends; what is there already is skipped
    python3 bench/ablation.py table OUT.jsonl   # sorted by effect

Needs nothing but Python 3 and cargo. `build` copies the workspace to `--work` and rewrites the copy:
each constant of the rooms below becomes a function that one run-time switch multiplies by 2 or by
1/2, and each single-line condition of an `if` can be forced to hold or not to hold. What does not
compile that way (lengths of arrays, `const fn`) keeps its form. `measure` then follows rendered
drives with one override at a time, each over the drives that reach it. A result that is equal to
the last byte shows that an override has no effect on them (but for values that a static keeps from
the baseline). All of it takes a night on two cores;
`--only fixed_pattern --drives 5` is faster, over the drives that reach most.
"""

import argparse
import json
import os
import re
import select
import shutil
import subprocess
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ROOMS = (
    "buffer camera continuous_time detection filter fixed_pattern flow image keyframe landmark motion "
    "mounting odometry loop_closure place_recognition pose_graph slam numerics self_calibration"
).split()
# Drives that differ in what they need of the tracker; the name of a row of the gate or the field,
# and its seed.
DRIVES = (
    "concrete tiles faint-noise vibration blur-33ms hand-held-small tilt-unknown tilt-unknown-live "
    "height-told-2pct-low fast rolling-20ms rolling-gravel rolling-tiles-shadow rolling-vibration "
    "rolling-undulation-told bumper own-lamp own-shadow relief-15mm undulation-ride ramp-ride kerb "
    "blackout-2s h264-qp28 loop dropped roll20-hand wind lost-blocks snow dead-lines overlay "
    "wheel-concrete torn duplicated interlaced kerb-lanes undulation-lanes"
).split()
CONSTANT = re.compile(
    r"^( *)((?:pub(?:\([a-z: ]+\))? )?)const ([A-Z][A-Z_0-9]*): (f64|f32|usize|u32|u64|i32|i64|u8) =\s([^;]*);",
    re.M,
)
CONDITION = re.compile(r"\bif ((?:(?!\blet\b)[^{}\n])+) \{$", re.M)


def sources(root):
    base = root / "crates/odograph/src"
    for room in ROOMS:
        files = list(base.glob(f"{room}.rs")) + sorted(base.glob(f"{room}/**/*.rs"))
        for file in files:
            if "tests" not in file.parts and file.name != "tests.rs" and "simd" not in file.parts:
                yield file


def code_spans(text):
    """The text in pieces: (is code to be rewritten, piece)."""
    pattern = re.compile(r"^\s*//[^\n]*\n|^\s*(?:pub(?:\([a-z]+\))? )?use [^;]*;\n|//[^\n]*|\"(?:[^\"\\]|\\.)*\"", re.M)
    at = 0
    for match in pattern.finditer(text):
        yield True, text[at : match.start()]
        yield False, match.group(0)
        at = match.end()
    yield True, text[at:]


def rewritten(text, name, items, names, excluded):
    """The instrumented source; appends the constants and conditions to `items`."""
    split = text.find("#[cfg(test)]\nmod tests {")
    text = text if split < 0 else text[:split]
    replaced = re.compile(r"(?<![\w:])(?:(?P<path>(?:\w+::)*)(?P<name>" + "|".join(sorted(names)) + r"))\b(?!\()")

    def item(kind, line, what):
        items.append({"id": len(items), "kind": kind, "file": name, "line": line, "what": what})
        return len(items) - 1

    def line_of(position):
        return text.count("\n", 0, position) + 1

    def constant(match):
        indent, visible, const, kind, value = match.groups()
        if const not in names:
            return match.group(0)
        number = item("constant", line_of(match.start(3)), f"{const} = {' '.join(value.split())}")
        lines = "\n" * (match.group(0).count("\n"))
        return f"{indent}#[allow(non_snake_case)] {visible}fn {const}() -> {kind} {{ crate::ablation::value({number}, {{ {' '.join(value.split())} }}) }}{lines}"

    def condition(match):
        line = line_of(match.start())
        if f"{name}:{line}" in excluded:
            return match.group(0)
        number = item("branch", line, match.group(1))
        return f"if crate::ablation::branch({number}, {match.group(1)}) {{"

    text = CONSTANT.sub(constant, text)
    text = CONDITION.sub(condition, text)
    pieces = []
    for is_code, piece in code_spans(text):
        if is_code and names:
            piece = replaced.sub(lambda m: m.group(0) + "()", piece)
            piece = re.sub(r"fn ([A-Z][A-Z_0-9]*)\(\)\(\)", r"fn \1()", piece)
        pieces.append(piece)
    return "".join(pieces)


def build(arguments):
    work = arguments.work
    copy = work / "copy"
    excluded_file = work / "excluded.json"
    excluded_names, excluded = map(set, json.loads(excluded_file.read_text()) if excluded_file.exists() else ([], []))
    for attempt in range(60):
        shutil.rmtree(copy / "crates", ignore_errors=True)
        shutil.copytree(ROOT / "crates", copy / "crates", ignore=shutil.ignore_patterns("target"))
        shutil.copytree(ROOT / "bench", copy / "bench", dirs_exist_ok=True)
        for extra in ["Cargo.toml", "Cargo.lock", "README.md", "clippy.toml", "rust-toolchain.toml"]:
            if (ROOT / extra).exists():
                shutil.copy(ROOT / extra, copy / extra)
        names = set()
        for file in sources(copy):
            text = file.read_text().split("#[cfg(test)]\nmod tests {")[0]
            names |= {match.group(3) for match in CONSTANT.finditer(text)}
        names -= excluded_names
        items = []
        for file in sources(copy):
            name = str(file.relative_to(copy))
            file.write_text(rewritten(file.read_text(), name, items, names, excluded))
        library = (ROOT / "bench/ablation/library.rs").read_text()
        base = copy / "crates/odograph/src"
        (base / "ablation.rs").write_text(library + f"\nconst COUNT: usize = {len(items)};\n")
        text = (base / "lib.rs").read_text()
        (base / "lib.rs").write_text(text.replace("pub mod error;", "#[allow(missing_docs)]\npub mod ablation;\npub mod error;", 1))
        gate = copy / "crates/odograph-gate/src"
        shutil.copy(ROOT / "bench/ablation/gate.rs", gate / "ablation.rs")
        text = (gate / "main.rs").read_text()
        text = text.replace("mod alterations;", "mod ablation;\nmod alterations;", 1)
        text = text.replace(
            "fn main() -> ExitCode {",
            "fn main() -> ExitCode {\n    let words: Vec<String> = std::env::args().skip(1).collect();\n"
            '    if words.first().is_some_and(|word| word == "--ablation") {\n        return ablation::main(&words[1..]);\n    }',
            1,
        )
        (gate / "main.rs").write_text(text)
        text = (gate / "measuring.rs").read_text()
        for function in ["against_exact_truth", "times_lost"]:
            text = text.replace(f"fn {function}(", f"pub fn {function}(", 1)
        (gate / "measuring.rs").write_text(text)
        environment = {"CARGO_TARGET_DIR": str(work / "target"), "RUSTFLAGS": "--cap-lints allow"}
        result = cargo(copy, environment, "check", "--message-format", "json", "-p", "odograph")
        places = errors(result)
        if not places:
            break
        before = (len(excluded), len(excluded_names))
        for name, line, message in places:
            lines = (copy / name).read_text().split("\n")
            around = "\n".join(lines[line - 1 : line])
            found = set(re.findall(r"\b([A-Z][A-Z_0-9]*)\b", around)) & names
            excluded_names |= found
            if not found or "branch(" in around:
                excluded.add(f"{name}:{line}")
            if not found and "branch(" not in around:
                print("cannot mend", name, line, message, around)
        print(f"attempt {attempt}: {len(places)} errors, {len(excluded_names)} constants and {len(excluded)} lines excluded")
        excluded_file.write_text(json.dumps([sorted(excluded_names), sorted(excluded)]))
        if before == (len(excluded), len(excluded_names)):
            raise SystemExit("no progress")
    else:
        raise SystemExit("does not compile")
    cargo(copy, environment, "build", "--release", "-q", "-p", "odograph-gate", quiet=False)
    (work / "items.json").write_text(json.dumps(items))
    print(len(items), "constants and branches")


def cargo(folder, environment, *words, quiet=True):
    return subprocess.run(
        ["cargo", *words], cwd=folder, env={**os.environ, **environment}, text=True,
        stdout=subprocess.PIPE if quiet else None, stderr=subprocess.DEVNULL if quiet else None, check=not quiet,
    ).stdout  # fmt: skip


def errors(output):
    places = []
    for line in output.splitlines():
        message = json.loads(line).get("message") or {}
        if message.get("level") == "error":
            for span in message.get("spans", []):
                if span["is_primary"]:
                    places.append((span["file_name"], span["line_start"], message["message"]))
    return places


class Worker:
    """The instrumented gate with all drives in memory."""

    def __init__(self, work):
        self.command = [work / "target/release/gate", "--ablation", *DRIVES]
        self.begin()

    def begin(self):
        self.process = subprocess.Popen(
            self.command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0
        )
        self.baseline = [json.loads(self.process.stdout.readline()) for _ in DRIVES]

    def ask(self, number, factor, drives, longest_s):
        """The results of the drives, or `None` if they take too long: an endless loop, mostly."""
        self.process.stdin.write(f"{number} {factor} {' '.join(map(str, drives))}\n".encode())
        if select.select([self.process.stdout], [], [], longest_s)[0]:
            line = self.process.stdout.readline()
            if line:
                return json.loads(line)
        self.process.kill()
        self.begin()
        return None


def jobs(items, baseline, most):
    """What is to be overridden by what, and over which drives."""
    reach = [[drive for drive, row in enumerate(baseline) if row["reached"][item["id"]]] for item in items]
    richness = [sum(drive in one for one in reach) for drive in range(len(DRIVES))]
    # Constants are doubled and halved; a branch that goes one way is forced to go the other way.
    for kind, factor, bit in [("constant", 2.0, 1), ("branch", 0.0, 1), ("branch", 1.0, 2), ("constant", 0.5, 1)]:
        for item, drives in zip(items, reach):
            if item["kind"] == kind:
                ones = [drive for drive in drives if baseline[drive]["reached"][item["id"]] & bit]
                yield item, factor, sorted(ones, key=lambda drive: -richness[drive])[:most]


def key_of(item, factor):
    return f"{item['file']}:{item['line']} {item['what']} {factor}"


def measure(arguments):
    items = json.loads((arguments.work / "items.json").read_text())
    output = arguments.output
    done = set()
    if output.exists():
        done = {json.loads(line)["key"] for line in output.read_text().splitlines()}
    first = Worker(arguments.work)
    (arguments.work / "baseline.json").write_text(json.dumps(first.baseline))
    todo = [job for job in jobs(items, first.baseline, arguments.drives) if key_of(job[0], job[1]) not in done and arguments.only in job[0]["file"]]
    print(len(todo), "overrides", flush=True)
    lock = threading.Lock()

    def work(worker):
        while True:
            with lock:
                if not todo:
                    break
                item, factor, drives = todo.pop(0)
            results = {}
            if drives:
                results = worker.ask(item["id"], factor, drives, 20.0 + 10.0 * len(drives))
            record = {"key": key_of(item, factor), "factor": factor, **item, "results": results}
            with lock, output.open("a") as file:
                file.write(json.dumps(record) + "\n")

    threads = [threading.Thread(target=work, args=[first])]
    threads += [threading.Thread(target=lambda: work(Worker(arguments.work))) for _ in range(arguments.workers - 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def effect(record, baseline):
    """How much worse a drive gets, at most, and how much better, in per cent of its error."""
    if record["results"] is None:
        return "hangs", 0.0, 0.0
    if not record["results"]:
        return "not reached", 0.0, 0.0
    worse, better, same = 0.0, 0.0, True
    for name, result in record["results"].items():
        usual = baseline[name]
        if "error" in result:
            return result["error"], 0.0, 0.0
        same &= result["hash"] == usual["hash"]
        # 0.001 % of the path is what the error varies by from draw to draw.
        ratio = (result.get("drift_percent", 100) + 0.001) / (usual["drift_percent"] + 0.001)
        lost = usual["posed_percent"] - result["posed_percent"]
        worse = max(worse, 100 * (ratio - 1), 10 * lost)
        better = max(better, 100 * (1 - ratio), -10 * lost)
    return "same bytes" if same else "", worse, better


def table(arguments):
    baseline = {row["row"]: row["result"] for row in json.loads((arguments.work / "baseline.json").read_text())}
    rows = []
    for line in arguments.output.read_text().splitlines():
        record = json.loads(line)
        rows.append((*effect(record, baseline), record))
    for note, worse, better, record in sorted(rows, key=lambda row: (row[0], row[1])):
        print(f"{note:12} {worse:8.1f} {better:6.1f}  x{record['factor']:<4} {record['file'][20:]}:{record['line']}  {record['what'][:90]}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["build", "measure", "table"])
    parser.add_argument("output", nargs="?", type=Path)
    parser.add_argument("--work", type=Path, default=Path("/tmp/ablation"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--drives", type=int, default=len(DRIVES), help="drives per override, at most")
    parser.add_argument("--only", default="", help="part of the file's name")
    arguments = parser.parse_args()
    {"build": build, "measure": measure, "table": table}[arguments.command](arguments)


if __name__ == "__main__":
    main()
