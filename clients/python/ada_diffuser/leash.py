"""`python leash.py PARENT PROGRAM ARGUMENTS`: becomes the program, which is killed when the process PARENT ends, however that ends.

It imports nothing of the package: as a file of its own it stands before every program that a command starts, and must be quick.
"""

import ctypes
import os
import signal
import sys

#: Of Linux: the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1


def end_with(parent: int) -> None:
    """This process is killed when `parent`, which started it, ends; at once if it has ended already."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit("the process that wanted this one has ended already")


if __name__ == "__main__":
    end_with(int(sys.argv[1]))
    os.execvp(sys.argv[2], sys.argv[2:])
