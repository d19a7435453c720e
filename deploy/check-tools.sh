#!/bin/sh
# Names each tool that is missing, with the command that installs it on Debian or Ubuntu.
python=${1:-python3}
missing=0
need() {
    command -v "$1" >/dev/null 2>&1 || { echo "missing: $1    install it with: $2" >&2; missing=1; }
}
need cc "apt-get install build-essential"
need cargo "curl --proto '=https' --tlsv1.2 -sSf https://sh.rustup.rs | sh"
need "$python" "apt-get install python3 python3-venv"
if command -v "$python" >/dev/null 2>&1; then
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
        echo "$python is older than 3.11    name another: make PYTHON=python3.11 ..." >&2; missing=1; }
    "$python" -c 'import ensurepip, venv' 2>/dev/null || {
        echo "missing: the venv module of $python    install it with: apt-get install python3-venv" >&2; missing=1; }
fi
exit $missing
