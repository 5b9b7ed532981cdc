"""New Python processes, for what depends on how a process begins, such as which packages it imports."""

import os
import subprocess
import sys


def run_python(program, *arguments, env=None, cwd=None, timeout=300):
    """Runs a program in a new process.

    Args:
        program: Source of the program.
        arguments: Its arguments, for `sys.argv`.
        env: Environment; None for this process's.
        cwd: Working directory; None for this process's.
        timeout: Time limit, s.

    Returns:
        The `subprocess.CompletedProcess`, with output and errors as text.
    """
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        env=os.environ if env is None else env,
        cwd=cwd,
        timeout=timeout,
        capture_output=True,
        text=True,
    )
