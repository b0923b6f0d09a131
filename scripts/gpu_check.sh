#!/bin/sh
# Checks Skugga on a machine with a graphics card that has Python 3.12 and no internet.
# Copy the working tree and FOLDER to it between the two steps. The second one ends after at most ten minutes.
#
# Usage: gpu_check.sh pack FOLDER [--provided NAMES] [--max-mib 64] [--preset 6]     here, with internet
#        gpu_check.sh run FOLDER OUT [--allow-software] [--minutes 9.5]              there
# (PYTHON=... in the environment names the interpreter)
#
# Results are OUT/report.md, report.json and pictures.zip: how OpenGL was loaded, stored pictures, tests of tests/terrain/gl, short
# benchmarks. --allow-software accepts Mesa. UNTESTED on a card.
set -eu

root=$(cd "$(dirname "$0")/.." && pwd)
command=${1:-}
[ $# -eq 0 ] || shift

is_target_python() {
    "$1" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null
}

case $command in
    pack)
        python=$root/.venv/bin/python
        [ -x "$python" ] || python=python3
        PYTHONPATH=$root exec "${PYTHON:-$python}" -m scripts.gpu_pack "$@"
        ;;
    run)
        # The first that fits: 'python3' may be an environment with packages that 'python3.12' lacks.
        python=python3
        is_target_python "$python" || python=python3.12
        PYTHONPATH=$root exec "${PYTHON:-$python}" "$root/scripts/gpu_check.py" "$@"
        ;;
    *)
        sed -n '2,7s/^#\( \|$\)//p' "$0" >&2
        exit 2
        ;;
esac
