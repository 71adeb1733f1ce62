"""The student's process: `python -I worker.py ORDER`, started by sandbox.py. Up to `shut_in` it is our own code, with
nothing but the standard library; then all that keeps the student's code in is in force, and it can only be tightened.

Two processes: the guard, which stays as it was started, and its child, in which the student's code runs. The guard ends
the child when the time is over, and whatever the child left behind.
"""
import contextlib
import ctypes
import json
import os
import resource
import signal
import struct
import sys

LIBC = ctypes.CDLL(None, use_errno=True)
NEW_MOUNTS, NEW_IPC, NEW_USER, NEW_PIDS, NEW_NETWORK = 0x20000, 0x8000000, 0x10000000, 0x20000000, 0x40000000
READ_ONLY, NO_SUID, NO_DEVICES, REMOUNT, BIND, RECURSIVE, PRIVATE = 1, 2, 4, 32, 4096, 16384, 1 << 18
KEPT = 1 | 2 | 4 | 8 | 1024 | 2048  # flags of a mount that a remount in a user namespace must repeat
DEATH_SIGNAL, DUMPABLE, NO_NEW_PRIVILEGES = 1, 4, 38  # of prctl


def call(name, *arguments):
    """A function of the C library; raises OSError where it fails."""
    if getattr(LIBC, name)(*arguments):
        raise OSError(ctypes.get_errno(), f"{name}: {os.strerror(ctypes.get_errno())}")


def mount(source, target, kind, flags, data=None):
    """mount(2), with text for its arguments; raises OSError."""
    encoded = [text and text.encode() for text in (source, target, kind, data)]
    call("mount", *encoded[:3], ctypes.c_ulong(flags), encoded[3])


def own_namespaces():
    """Processes, network and mounts of its own, where the kernel lets this user have them -> whether it does."""
    user, group = os.getuid(), os.getgid()
    flags = NEW_MOUNTS | NEW_IPC | NEW_PIDS | NEW_NETWORK
    try:
        call("unshare", flags if user == 0 else flags | NEW_USER)
    except OSError:
        return False
    if user:
        for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
            with open(f"/proc/self/{name}", "w") as file:
                file.write(text)
    return True


def own_root(root, visible, hidden, work, user):
    """See nothing of the disk but `visible`, read-only, and an empty folder `work` in memory -> whether that is so."""
    try:
        mount(None, "/", None, RECURSIVE | PRIVATE)
        mount("tmpfs", root, "tmpfs", NO_SUID | NO_DEVICES, "size=64m,mode=755")
        for path in visible:
            target = root + path
            if os.path.isdir(path):
                os.makedirs(target, exist_ok=True)
            else:
                os.makedirs(os.path.dirname(target), exist_ok=True)
                open(target, "w").close()
            mount(path, target, None, BIND | RECURSIVE)
            kept = os.statvfs(path).f_flag & KEPT
            mount(None, target, None, REMOUNT | BIND | READ_ONLY | kept)
        for path in hidden:
            mount("tmpfs", root + path, "tmpfs", READ_ONLY, "mode=000")
        os.makedirs(root + work)
        os.chown(root + work, *user)
        os.chroot(root)
        return True
    except OSError:
        return False


def shut_in(order, limits):
    """The limits and an unprivileged user, for good."""
    for name, value in limits.items():
        resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (value, value))
    if order["user"] is not None:
        os.setgroups([])
        os.setgid(order["user"])
        os.setuid(order["user"])
    call("capset", (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)())  # gives up what a namespace brought
    call("prctl", NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    os.umask(0o077)
    os.chdir(order["work"])
    os.environ.clear()
    os.environ.update(TMPDIR=order["work"], HOME=order["work"], OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")


def send(descriptor, content):
    """One frame, as channel.frame has it: this file is on its own until it is shut in."""
    content = struct.pack("<Q", len(content)) + content
    while content:
        content = content[os.write(descriptor, content):]


def watch(child, order, apart):
    """The guard: wait for the child, at most so long; end it and what it left; go as it went. Where processes are its
    own (apart), the kernel ends all the others with the child.
    """
    def end(*_):
        try:
            os.kill(child, signal.SIGKILL)
        except ProcessLookupError:  # it is no more
            pass
    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, order["wall"])
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if order["user"] is not None and not apart:
        if os.fork() == 0:  # as that user: kill all others that are left of it
            os.setuid(order["user"])
            os.kill(-1, signal.SIGKILL)
            os._exit(0)
        os.wait()
    os._exit(code if code >= 0 else 128 - code)


# --- what the student's code is asked, once it is shut in --------------------------------------------------------

def answer_task(file, number, cases):
    """The answers of one task's function on its cases, as `task.answer` gives them, in plain types."""
    from hind4sight_min.course import ASSIGNMENTS, carve
    from hind4sight_min.course.task import answers_of
    task, = [task for assignment in ASSIGNMENTS for task in assignment.tasks if task.number == number]
    return [[list(each.value), each.gradients, each.error]
            for each in answers_of(task, carve.load_student(file, task), cases)]


def measure_bug(file, number):
    """What the student's measurement says of the package that lies beside this one."""
    from hind4sight_min.course import bugs
    folder = sys.path.pop(0)
    return bugs.measure(file, number, bugs.import_package(folder))


def improve(file, interactions, pokes, seed):
    """The student's train(interactions, seed) -> predict, and predict(pokes) -> scene flow, an array."""
    import numpy as np
    from hind4sight_min.course.task import namespace_of
    from hind4sight_min.geometry import Camera
    from hind4sight_min.interactions import Interactions
    data = [Interactions(**{**each, "camera": Camera(**each["camera"])}) for each in (interactions, pokes)]
    predict = namespace_of(file)["train"](data[0], seed)
    return np.asarray(predict(data[1]))


WORK = {"task": answer_task, "bug": measure_bug, "improve": improve}


# --- all of it ---------------------------------------------------------------------------------------------------

def main(order):
    """Shut in, then answer what the grader asks on order["inputs"]; the answer goes to order["results"]."""
    results, user = order["results"], order["user"]
    call("prctl", DEATH_SIGNAL, signal.SIGTERM, 0, 0, 0)
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")  # many processes' memory together is not limited: where it runs out, these go first
    apart = order["namespaces"] and own_namespaces()
    owner = (os.getuid(), os.getgid()) if user is None else (user, user)
    rooted = apart and own_root(order["root"], order["visible"], order["hidden"], order["work"], owner)
    isolation = {"own user": user is not None, "own processes and network": apart, "own root": rooted}
    send(results, json.dumps(isolation).encode())
    call("prctl", DUMPABLE, 0, 0, 0, 0)  # nobody reads our memory
    child = os.fork()
    if child:
        os.close(results)
        watch(child, order, apart)
    try:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        shut_in(order, order["limits"])
        sys.path[:0] = [order["package"]]
        sys.path += order["libraries"]
        from hind4sight_min.course import channel
        with os.fdopen(order["inputs"], "rb") as file:
            job = channel.decode(channel.frames(file.read())[0])
        for name, content in job.pop("files").items():
            with open(name, "wb") as file:
                file.write(content.tobytes())
        work = WORK[job.pop("kind")]
        send(results, b"ready")  # nothing that is sent from here on can be trusted
        try:
            answer = {"answer": work(**job)}
        except (Exception, SystemExit) as error:
            answer = {"failed": f"{type(error).__name__}: {error}"}
        with os.fdopen(results, "wb") as file:
            file.write(channel.encode(answer))
        sys.stdout.flush()
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        os._exit(1)
    os._exit(0)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
