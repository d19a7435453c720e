"""`python leash.py PARENT PROGRAM ARGUMENTS`: becomes the program, which is killed when the process PARENT ends, however that ends.

A file of its own that imports nothing of the package: it stands before every program that a command starts, and must be quick.
"""

import ctypes
import os
import signal
import sys

#: Of Linux: the signal that a process gets when its parent ends.
_PR_SET_PDEATHSIG = 1

if __name__ == "__main__":
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(sys.argv[1]):
        sys.exit("the process that wanted this program has ended already")
    os.execvp(sys.argv[2], sys.argv[2:])
