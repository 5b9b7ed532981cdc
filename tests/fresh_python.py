"""New Python processes, for what depends on how a process begins, such as which packages it imports."""

import os
import subprocess
import sys


def run_python(program, *arguments, env=None, cwd=None, timeout=300):
    """Runs a program, with arguments for `sys.argv`; returns the process with output and errors as text."""
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        env=os.environ if env is None else env,
        cwd=cwd,
        timeout=timeout,
        capture_output=True,
        text=True,
    )
