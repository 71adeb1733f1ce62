"""A student's code in a process of its own, shut in as far as the kernel lets us: see worker.py for how.

Three degrees, and every outcome tells which was in force. As root, or where an ordinary user may have namespaces: a
root folder, processes and a network of its own. As root without those (most containers): a user id of its own.
Otherwise: limits and a time-out alone. docs/teaching.md says what each stops.
"""
import ctypes
import json
import os
import pwd
import random
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ..disk.files import shares
from . import channel
from .bugs import PACKAGE

WORKER = Path(__file__).with_name("worker.py")
HIDDEN = PACKAGE, *shares()  # there lies the shipped pokes' truth


@dataclass(frozen=True)
class Limits:
    """What one process of a student's may take: seconds of CPU and on the wall, bytes of memory, processes and threads,
    bytes of a file (its prints are one), open files, bytes of its answer.
    """
    cpu: int = 10
    wall: float = 60.0
    memory: int = 2 << 30
    processes: int = 32
    file: int = 16 << 20
    files: int = 128
    answer: int = 64 << 20


@dataclass(frozen=True)
class Outcome:
    """What came of one run. answer: what the student's process sent, or None. failure: why there is none, or "".
    raised: whether that is an exception's text. isolation: what was in force, in words. prints: the last it printed.
    """
    answer: object
    failure: str
    raised: bool
    isolation: str
    prints: str


def run(package, job, limits=Limits(), namespaces=True):
    """Let a student's process do one job with the package that lies in the folder `package` -> Outcome.

    Not in the paper: grading. job: {"kind": see worker.WORK, "files": {name: bytes}, ...}, as channel.encode takes it.
    namespaces=False does without those, to see what then holds.
    Raises RuntimeError where the process does not even get as far as the student's code.
    """
    ctypes.CDLL(None).prctl(4, 0, 0, 0, 0)  # PR_SET_DUMPABLE: from now on the same user cannot read our memory
    files = {name: np.frombuffer(content, np.uint8) for name, content in job["files"].items()}
    with tempfile.TemporaryFile() as inputs, tempfile.TemporaryFile() as prints, free_user() as user, \
            temporary_folder(user) as box:
        inputs.write(channel.encode({**job, "files": files}))
        inputs.seek(0)
        result, results = os.pipe()
        order = {"inputs": inputs.fileno(), "results": results, "user": user, "wall": limits.wall,
                 "namespaces": namespaces, "root": f"{box}/root", "work": f"{box}/work", "package": str(package),
                 **surroundings(package), "limits": {
                     "CPU": limits.cpu, "AS": limits.memory, "FSIZE": limits.file, "NOFILE": limits.files, "CORE": 0,
                     "NPROC": limits.processes + (0 if user is not None else tasks_by_user()[os.getuid()])}}
        process = subprocess.Popen(
            [sys.executable, "-I", "-B", str(WORKER), json.dumps(order)], stdin=subprocess.DEVNULL, stdout=prints,
            stderr=prints, cwd="/", env={}, start_new_session=True, pass_fds=(inputs.fileno(), results))
        os.close(results)
        try:
            content, ending = read_all(result, limits.answer, time.monotonic() + limits.wall + 5)
        finally:
            os.close(result)
            stop(process)
        prints.seek(max(0, os.fstat(prints.fileno()).st_size - 4000))
        return outcome(content, ending, process.returncode, prints.read().decode(errors="replace"), limits)


def read_all(descriptor, most, deadline):
    """Read a pipe to its end -> bytes, and "" or why we stopped before: "time" or "size"."""
    content = bytearray()
    while True:
        left = deadline - time.monotonic()
        if left <= 0 or not select.select([descriptor], [], [], left)[0]:
            return content, "time"
        piece = os.read(descriptor, 1 << 20)
        if not piece:
            return content, ""
        content += piece
        if len(content) > most:
            return content, "size"


def stop(process):
    """Let the guard end, ask it to, and kill its process group, in which an ordinary user's leftovers are."""
    for ask in (lambda: None, process.terminate, lambda: os.killpg(process.pid, signal.SIGKILL)):
        try:
            ask()
            process.wait(timeout=2)
        except (subprocess.TimeoutExpired, ProcessLookupError):  # on to the next
            pass
    process.wait()


def outcome(content, ending, code, prints, limits):
    """The Outcome of what came through the pipe, why it ended, the guard's exit code and the prints."""
    parts, whole = channel.frames(content)
    if len(parts) < 2 or bytes(parts[1]) != b"ready":  # what comes before that is not the student's
        last = prints.strip().splitlines()[-1:] or [f"exit status {code}"]
        raise RuntimeError(f"sandbox: the student's process cannot begin ({last[0]}); {sys.executable} and its "
                           "packages must be readable for every user, the limits large enough to import NumPy")
    in_force = [name for name, holds in json.loads(bytes(parts[0])).items() if holds]
    answer, failure, raised = None, "", False
    if ending == "size":
        failure = f"The answer is longer than {limits.answer >> 20} MB."
    elif whole and len(parts) > 2:
        try:
            answer = channel.decode(parts[2:])
            if not isinstance(answer, dict) or [*answer] not in (["answer"], ["failed"]):
                raise ValueError("it has another form")
            failure, raised = one_line(answer.get("failed", "")), "failed" in answer
        except ValueError as error:
            failure = f"What came back is no answer: {one_line(error)}."
    elif ending == "time" or code == 128 + signal.SIGKILL:
        failure = f"No answer within {limits.cpu} s of computing, {limits.wall:.0f} s in all: does every loop end?"
    else:
        failure = f"The process ended (exit status {code}) before it answered: does the code call exit()?"
    isolation = ", ".join([*in_force, "limits", "time-out"])
    return Outcome(None if failure else answer["answer"], failure, raised, isolation, prints)


def one_line(text, most=300):
    """Text from a student's process, fit for a terminal: one line, printable, not too long."""
    line = " ".join(str(text).split())
    return "".join(each if each.isprintable() else "?" for each in line)[:most]


# --- users, folders, what is to be seen --------------------------------------------------------------------------

TAKEN, LOCK = set(), threading.Lock()


def tasks_by_user():
    """How many tasks, processes and their threads, every user id has -> Counter."""
    found = Counter()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            found[folder.stat().st_uid] += len(os.listdir(folder / "task"))
        except OSError:  # it has ended meanwhile, or is not ours to look into
            pass
    return found


@contextmanager
def free_user():
    """As root, a user id that no account, no process and no other run has, while the block lasts; else None."""
    if os.getuid():
        yield None
        return
    with LOCK:
        used = {account.pw_uid for account in pwd.getpwall()} | {*tasks_by_user()} | TAKEN
        user = random.choice([each for each in range(60100, 64900) if each not in used])
        TAKEN.add(user)
    try:
        yield user
    finally:
        TAKEN.discard(user)


@contextmanager
def temporary_folder(user):
    """A folder with the folders root, for a root of its own, and work, which `user` alone can use; both vanish."""
    box = tempfile.mkdtemp(prefix="hind4sight-")
    try:
        os.chmod(box, 0o711)
        os.mkdir(f"{box}/root")
        os.mkdir(f"{box}/work", 0o700)
        if user is not None:
            os.chown(f"{box}/work", user, user)
        yield box
    finally:
        shutil.rmtree(box, ignore_errors=True)


def surroundings(package):
    """What a student's process sees of the disk, and what of that it does not: this very package and its data."""
    libraries = sorted({str(Path(find_spec(name).origin).parents[1])
                        for name in ("numpy", "scipy", "cv2", "autograd")})
    paths = ["/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache", "/dev/null", "/dev/urandom", sys.base_prefix,
             sys.prefix, *libraries, str(package)]
    visible = []
    for path in paths:
        if os.path.exists(path) and not any(Path(path).is_relative_to(other) for other in visible):
            visible.append(path)
    hidden = [str(folder) for folder in HIDDEN
              if folder.is_dir() and any(folder.is_relative_to(path) for path in visible)]
    return {"visible": visible, "hidden": hidden, "libraries": libraries}
