"""New Python processes that need not import PyTorch: they are forked from one that has.

LeRobot's commands take 10 s to start, most of which is the import of PyTorch and other large packages, which
read none of the environment's variables that a test may set. Here, one process imports these when it is first
needed, and is forked for each program. The program itself imports LeRobot, the Hugging Face libraries and
this project, with its own environment. What PyTorch or NumPy read when they are imported, such as
OMP_NUM_THREADS, is that of the first process, and so are its hash seed and NumPy's global random state.
"""

import contextlib
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import types
import warnings
from pathlib import Path

ADDRESS = "DELTACO_FRESH_PYTHON"
PACKAGES = (
    "torch",
    "torchvision",
    "pandas",
    "pyarrow.parquet",
    "scipy.stats",
    "sklearn.metrics",
    "gymnasium",
)


def start_server(folder):
    """Starts the process that is forked, which listens at a socket in a folder; `stop_server` ends it."""
    path = str(folder / "socket")
    # It ends with its input, however this process ends.
    server = subprocess.Popen([sys.executable, __file__, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    if not server.stdout.readline():
        raise RuntimeError(f"The process of tests/fresh_python.py does not listen at {path}.")
    os.environ[ADDRESS] = path
    return server


def stop_server(server):
    os.environ.pop(ADDRESS, None)
    server.stdin.close()
    server.stdout.close()
    server.wait()


def run_python(program, *arguments, env=None, cwd=None, timeout=300):
    """Runs a program in a new process, as `subprocess.run([sys.executable, "-c", program, ...])` would.

    Args:
        program: Source of the program.
        arguments: Its arguments, for `sys.argv`.
        env: Environment; None for this process's.
        cwd: Working directory; None for this process's.
        timeout: Seconds after which the program is reported as hanging.

    Returns:
        The `subprocess.CompletedProcess`, with output and errors as text. It has no input to read.
    """
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as connection:
        output, errors = Path(folder, "output"), Path(folder, "errors")
        connection.settimeout(timeout)
        connection.connect(os.environ[ADDRESS])
        request = {
            "program": program,
            "arguments": list(map(str, arguments)),
            "env": dict(os.environ if env is None else env),
            "cwd": str(cwd or os.getcwd()),
            "output": str(output),
            "errors": str(errors),
        }
        connection.sendall(json.dumps(request).encode())
        connection.shutdown(socket.SHUT_WR)
        with connection.makefile() as answer:
            child = int(answer.readline())
            try:
                returncode = int(answer.readline())
            except TimeoutError:
                os.kill(child, signal.SIGKILL)
                raise RuntimeError(
                    f"A program has not ended after {timeout} s. Its errors:\n{errors.read_text()}"
                ) from None
        return subprocess.CompletedProcess(
            ["python", "-c", program], returncode, output.read_text(), errors.read_text()
        )


def _serve(path):
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen()
        sys.stdout.write("listening\n")
        sys.stdout.flush()
        is_ready = False
        while listening in select.select([listening, sys.stdin], [], [])[0]:
            connection, _ = listening.accept()
            if not is_ready:
                for name in PACKAGES:
                    importlib.import_module(name)
                is_ready = True
            while _ended_child():
                pass
            # One process waits for the program, another one is it. The threads that the packages may have
            # started are idle ones of memory allocators.
            warnings.filterwarnings("ignore", category=DeprecationWarning, message=".*fork")
            if os.fork():
                connection.close()
                continue
            with connection, connection.makefile() as received:
                request = json.load(received)
                child = os.fork()
                if child:
                    connection.sendall(f"{child}\n".encode())
                    _, status = os.waitpid(child, 0)
                    with contextlib.suppress(BrokenPipeError):  # nobody waits any more
                        connection.sendall(f"{os.waitstatus_to_exitcode(status)}\n".encode())
                    os._exit(0)
            return request
    sys.exit()


def _ended_child():
    try:
        return os.waitpid(-1, os.WNOHANG)[0]
    except ChildProcessError:
        return 0


def _run(request):
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    for number, (name, mode) in enumerate(
        ((os.devnull, os.O_RDONLY), (request["output"], os.O_WRONLY), (request["errors"], os.O_WRONLY))
    ):
        file = os.open(name, mode | os.O_CREAT)
        os.dup2(file, number)
        os.close(file)
    sys.argv = ["-c", *request["arguments"]]
    added = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:1] = ["", *filter(None, added)]  # in the place of this file's folder
    main = sys.modules["__main__"] = types.ModuleType("__main__")
    exec(compile(request["program"], "<string>", "exec"), main.__dict__)


if __name__ == "__main__":
    _run(_serve(sys.argv[1]))
