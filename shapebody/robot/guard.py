"""Robot files from elsewhere cannot take this process down.

A small text can make MuJoCo's reader crash, run for hours or fill the memory. So a file that is not
shipped is first surveyed as text, together with the files that it names, and refused if it asks for
more than any robot needs. Then it is read once in another process, under limits of time and memory.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import warnings
from pathlib import Path

from shapebody.files import data_dir
from shapebody.robot.importing import read
from shapebody.robot.survey import files_of

SECONDS = 120  # for one file; a mesh of 200,000 triangles takes up to 6
MEMORY = 2**32  # bytes
IDLE = 60  # seconds after which the other process ends


def admit(path: Path) -> None:
    """Survey a robot file and read it once in another process, unless it is a shipped one.

    The answer is kept until the file, or a file that it names, changes.

    Raises ValueError, naming the file, if it asks for more than a robot needs, or if reading it
    fails, crashes, or takes more than `SECONDS` or `MEMORY`; OSError if it cannot be opened.
    """
    if _is_shipped(path) or path.is_dir():
        return
    key = (os.path.abspath(path), str(path), tuple(sorted(files_of(path).items())))
    if key not in _answers:
        problem, lasting = reader.judge(path)
        if not lasting:
            raise ValueError(problem)
        _answers[key] = problem
    if _answers[key]:
        raise ValueError(_answers[key])


_answers: dict[tuple, str] = {}


def _is_shipped(path: Path) -> bool:
    try:
        return path.resolve().parent == (data_dir() / "robots").resolve()
    except (OSError, RuntimeError):  # no data folder; links that lead in a circle
        return False


# The other process, which ends by itself when it is not needed.


class Reader:
    """Reads robot files in another process, which is started when needed and replaced when lost."""

    def __init__(self):
        self.forget()
        atexit.register(self.stop)
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self.forget)

    def forget(self) -> None:
        """Start anew: the process that a fork copies belongs to its parent."""
        self.lock, self.process = threading.Lock(), None

    def stop(self) -> None:
        """End the other process, if there is one."""
        if self.process is not None:
            self.process.kill()
            self.process.communicate()  # closes the pipes
            self.process = None

    def judge(self, path: Path) -> tuple[str, bool]:
        """Why a file cannot be read ("" if it can), and whether that is worth keeping."""
        try:
            folder = os.getcwd()
        except OSError:  # it was deleted
            folder = "/"
        with self.lock:
            for _ in range(2):
                used = self.process is not None and self.process.poll() is None
                if not used and not self._start():
                    warnings.warn(
                        f"{path} is read without protection against files that crash MuJoCo, as "
                        f"no other process can be started with {sys.executable!r}",
                        stacklevel=5,
                    )
                    return "", True
                answer, late = self._ask({"folder": folder, "path": str(path)})
                if answer is not None:
                    return answer, True
                if late:
                    return (
                        f"{path} cannot be read within {SECONDS} s: expected the file of a robot; "
                        "give it simpler meshes and fewer elements"
                    ), False
                code = self._code()
                self.stop()
                if not used:  # else an earlier file, or its end after a pause, may be the cause
                    break
            return (
                f"{path} makes MuJoCo's reader crash ({_cause(code)}): expected an MJCF or URDF "
                "file of a robot. It happened in another process, so nothing is lost; to find the "
                "element that causes it, remove one half of the file after the other"
            ), True

    def _code(self) -> int | None:
        try:
            return self.process.wait(5)  # its pipe is closed before it has ended
        except subprocess.TimeoutExpired:
            return None

    def _start(self) -> bool:
        self.stop()
        search = [str(folder) for folder in sys.path]
        program = (
            f"import sys; sys.path[:] = {search!r}; import shapebody.robot.guard as g; g.serve()"
        )
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for this process
                env=os.environ | {"MUJOCO_GL": "disable", "OPENBLAS_NUM_THREADS": "1"},
            )
        except (OSError, ValueError):
            return False
        return self._ask(None)[0] is not None

    def _ask(self, request) -> tuple[str | None, bool]:
        """The answer, None if the process ends before; and whether it was too late."""
        process, late = self.process, threading.Event()

        def end():
            late.set()
            process.kill()

        timer = threading.Timer(SECONDS, end)
        timer.daemon = True
        timer.start()
        try:
            if request is not None:
                process.stdin.write(json.dumps(request).encode() + b"\n")
                process.stdin.flush()
            line = process.stdout.readline()
            return (json.loads(line) if line.endswith(b"\n") else None), late.is_set()
        except OSError:  # the pipe is closed
            return None, late.is_set()
        except BaseException:  # Ctrl-C: the answer would be taken for the next one
            self.stop()
            raise
        finally:
            timer.cancel()


reader = Reader()


def _cause(code: int | None) -> str:
    try:
        return signal.Signals(-code).name
    except (TypeError, ValueError):  # None; an exit status
        return f"exit status {code}"


def serve() -> None:
    """Answer requests from standard input until it ends: the other process."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what MuJoCo prints is not an answer
    limit_memory()
    _answer(answers, "")
    for line in sys.stdin.buffer:
        request = json.loads(line)
        _alarm(SECONDS + 5)  # if nobody is there any more to end it
        problem = ""
        try:
            with contextlib.suppress(OSError):  # only relative paths need it
                os.chdir(request["folder"])
            read(Path(request["path"]))
        except ValueError as error:
            problem = str(error)
        except (MemoryError, RuntimeError) as error:
            problem = (
                f"{request['path']} cannot be read in {MEMORY >> 30} GiB of memory ("
                f"{' '.join(str(error).split()) or type(error).__name__}): expected the file of a "
                "robot; give it smaller counts, sizes and meshes"
            )
        except Exception:  # it comes again, with its traceback, where it can be seen
            pass
        _answer(answers, problem)
        _alarm(IDLE)


def _answer(answers, problem: str) -> None:
    answers.write(json.dumps(problem).encode() + b"\n")
    answers.flush()


def _alarm(seconds: int) -> None:
    """Let the system end this process after some time."""
    if hasattr(signal, "alarm"):
        signal.alarm(seconds)


def limit_memory() -> None:
    """At most `MEMORY` more than now, and no core files, where the system knows such limits."""
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        most = pages * resource.getpagesize() + MEMORY
        if hard != resource.RLIM_INFINITY:
            most = min(most, hard)
        resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    except (ImportError, OSError, ValueError):
        pass
