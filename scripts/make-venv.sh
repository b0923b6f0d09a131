#!/bin/sh
# Makes the virtual environment FOLDER with the first Python that is new enough.
# Usage: make-venv.sh FOLDER    (PYTHON=... in the environment names the interpreter)
set -eu

folder=$1
here=$(dirname "$0")

new_enough() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

if [ -x "$folder/bin/python" ] && new_enough "$folder/bin/python" && "$folder/bin/python" -m pip --version >/dev/null 2>&1; then
    exit 0
fi

python=
for candidate in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11}; do
    if new_enough "$candidate"; then
        python=$candidate
        break
    fi
done
if [ -z "$python" ]; then
    echo "skugga: Python 3.11 or newer is needed and none was found (${PYTHON:-python3}); name one with PYTHON=..." >&2
    exit 1
fi

# Debian splits ensurepip off, without which a virtual environment has no pip.
if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    "$here/install-system-packages.sh" "Python's venv module is incomplete" "python$version-venv"
fi

"$python" -m venv --clear "$folder"
