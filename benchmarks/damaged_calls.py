"""Calls that cannot be meant: each must be refused by one sentence, at once, and never by a traceback of a library.

    python -m benchmarks.damaged_calls [--every N] [--only TEXT]

For each public function and each of its arguments, each of a set of wrong values takes the place of a right one; beside
them models, written by hand, that have a fault each. An answer is counted as

    refused   a `raise` of the package's own, ValueError, TypeError or another built-in fit for it, with a sentence
    warned    an answer, with a warning
    raw       any other exception: a traceback from inside NumPy, JAX or Python
    accepted  an answer without a word, although the value cannot be meant
    slow      no answer within the limit; whatever it would have been
    died      the process ended

Calls run in a process of their own with limited memory, which is started again when one of them ends it.
"""

import argparse
import contextlib
import io
import json
import linecache
import math
import os
import queue
import resource
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "ehsvjax"
GIBIBYTE = 2**30
# The longest that a call may take, and the longest that a refusal may, s.
LIMIT, AT_ONCE = 10.0, 1.0
REFUSALS = (ValueError, TypeError, OSError, ImportError, SystemExit)


class Call(NamedTuple):
    """One call: what is called, which argument is wrong in which way, and the call itself.

    `may_answer` says that an answer is right, as for the calls that are given nothing wrong.
    """

    name: str
    argument: str
    wrong: str
    run: Callable[[], Any]
    may_answer: bool = False


def damaged(name: str, function: Callable, arguments: dict[str, tuple[Any, dict[str, Any]]]) -> Iterator[Call]:
    """Yield the right call, and one for each wrong value of each argument: name -> (right value, label -> wrong)."""
    right = {argument: value for argument, (value, _) in arguments.items()}
    yield Call(name, "", "nothing", lambda: function(**right), may_answer=True)
    for argument, (_, wrong) in arguments.items():
        for label, value in wrong.items():
            yield Call(name, argument, label, lambda a=argument, v=value: function(**{**right, a: v}))


def every_call() -> list[Call]:
    """Return all calls; imports what they need."""
    from benchmarks import damaged_arguments, damaged_models, damaged_results

    return [*damaged_arguments.calls(), *damaged_results.calls(), *damaged_models.calls()]


class Answer(NamedTuple):
    """What a call came to, in how many seconds, and the words."""

    name: str
    argument: str
    wrong: str
    kind: str
    seconds: float
    words: str


def answer_of(call: Call) -> Answer:
    """Run one call and judge what it comes to."""
    # Of the processor: a busy neighbour makes no refusal late.
    began = time.process_time()
    silent = io.StringIO()
    with warnings.catch_warnings(record=True) as warned, contextlib.redirect_stdout(silent):
        warnings.simplefilter("always")
        try:
            with contextlib.redirect_stderr(silent):
                returned = call.run()
            kind, words = ("answered" if call.may_answer else "accepted"), repr(type(returned).__name__)
            if warned and not call.may_answer:
                kind, words = "warned", str(warned[0].message)
        except (Exception, SystemExit) as error:
            kind, words = judged(error, silent.getvalue())
    seconds = time.process_time() - began
    return Answer(call.name, call.argument, call.wrong, kind, seconds, " ".join(words.split())[:300])


def judged(error: BaseException, said: str) -> tuple[str, str]:
    """Return whether an exception is a refusal, and its words."""
    if isinstance(error, SystemExit):
        return ("refused" if "error: " in said else "raw"), said.strip().splitlines()[-1] if said else "SystemExit"
    words = f"{type(error).__name__}: {error}"
    last = traceback.extract_tb(error.__traceback__)[-1]
    ours = Path(last.filename).is_relative_to(PACKAGE)
    raised = linecache.getline(last.filename, last.lineno or 0).strip().startswith("raise")
    sentence = "expected" in str(error) or ": " in str(error)
    if ours and raised and sentence and isinstance(error, REFUSALS):
        return "refused", words
    return "raw", f"{words} [{Path(last.filename).name}:{last.lineno}]"


def work(start: int, step: int, only: str) -> None:
    """Answer every `step`-th call from `start` on, one line of JSON each, on the real standard output."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    calls = chosen(every_call(), step, only)
    os.chdir(tempfile.mkdtemp())
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + 6 * GIBIBYTE,) * 2)
    for number, call in enumerate(calls[start:], start):
        out.write(json.dumps([number, "begins", call.name, call.argument, call.wrong]) + "\n")
        out.write(json.dumps([number, *answer_of(call)]) + "\n")
    out.write(json.dumps([len(calls), "done"]) + "\n")


def chosen(calls: list[Call], step: int, only: str) -> list[Call]:
    """Return every `step`-th of the calls whose name has the text in it."""
    return [call for call in calls if only in call.name][::step]


def answers(step: int = 1, only: str = "") -> Iterator[Answer]:
    """Yield the answer of every call, from a process that is started again whenever a call ends it."""
    start = 0
    while True:
        command = [sys.executable, "-m", "benchmarks.damaged_calls", "--work", str(start)]
        command += ["--every", str(step), "--only", only]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=ROOT, text=True)
        lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=_forward, args=(process.stdout, lines), daemon=True).start()
        current = None
        while True:
            try:
                # Until the first call begins, the process imports and compiles.
                line = lines.get(timeout=LIMIT if current else 120.0)
            except queue.Empty:
                line = ""
            if not line:
                break
            number, what, *rest = json.loads(line)
            if what == "done":
                process.wait()
                return
            start, current = (number, rest) if what == "begins" else (number + 1, ["", "", ""])
            if what != "begins":
                yield Answer(what, *rest)
        kind = "died" if process.poll() is not None else "slow"
        process.kill()
        process.wait()
        if current is None:
            raise RuntimeError(f"expected the calls to begin, got a process that {kind}: run it by hand, {command}")
        yield Answer(*current, kind, LIMIT, "")
        start += 1


def _forward(stream, lines: "queue.Queue[str]") -> None:
    for line in stream:
        lines.put(line)
    lines.put("")


def offenders(found: list[Answer]) -> list[Answer]:
    """Return the answers that should not be: tracebacks, acceptance, right calls refused, refusals that take long."""
    return [
        a
        for a in found
        if a.kind not in ("refused", "warned", "answered")
        or (a.wrong == "nothing" and a.kind != "answered")
        or (a.kind == "refused" and a.seconds > AT_ONCE)
    ]


def table(found: list[Answer]) -> str:
    """Return the counts by function."""
    kinds = ("refused", "warned", "raw", "accepted", "slow", "died", "answered")
    counts = {name: Counter(a.kind for a in found if a.name == name) for name in dict.fromkeys(a.name for a in found)}
    width = max(map(len, counts), default=0)
    lines = [" ".join(["call".ljust(width), *(f"{kind:>9}" for kind in kinds), "slowest s"])]
    for name, count in counts.items():
        slowest = max((a.seconds for a in found if a.name == name and a.kind == "refused"), default=math.nan)
        lines.append(" ".join([name.ljust(width), *(f"{count[kind]:>9}" for kind in kinds), f"{slowest:9.2f}"]))
    total = Counter(a.kind for a in found)
    return "\n".join([*lines, " ".join([f"{len(found)} calls".ljust(width), *(f"{total[kind]:>9}" for kind in kinds)])])


def main() -> None:
    """Answer all calls, or every N-th, and print a table and the offenders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--every", type=int, default=1, help="only every N-th call")
    parser.add_argument("--only", default="", help="only calls with this text in their name")
    parser.add_argument("--work", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work is not None:
        work(options.work, options.every, options.only)
        return
    found = list(answers(options.every, options.only))
    print(table(found))
    for offender in offenders(found):
        what = f"{offender.name}({offender.argument}={offender.wrong})"
        print(f"{offender.kind:8} {offender.seconds:5.2f} s  {what}  {offender.words[:160]}")


if __name__ == "__main__":
    main()
