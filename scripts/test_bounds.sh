#!/bin/sh
# Run the tests of compiled code, of physics and of what ArviZ reads at both ends of the allowed versions: the lowest
# numba and mujoco on one Python, the highest of all packages on another (ArviZ 1 needs Python 3.12).
# usage: scripts/test_bounds.sh [OLDEST_PYTHON [NEWEST_PYTHON]]
set -eu
cd "$(dirname "$0")/.."
oldest=${1:-python3}
newest=${2:-$oldest}
lowest=$(sed -nE 's/^ *"(numba|mujoco)>=([0-9.]+),.*/\1==\2.*/p' pyproject.toml)
for end in low high; do
    if [ "$end" = low ]; then python=$oldest wanted=$lowest; else python=$newest wanted=""; fi
    "$python" -m venv ".venv-$end"
    # shellcheck disable=SC2086  # each is an argument of its own
    ".venv-$end/bin/python" -m pip install --quiet --disable-pip-version-check --upgrade -e '.[dev]' $wanted
    echo "== $end: $(".venv-$end/bin/python" --version)" \
        "$(".venv-$end/bin/python" -m pip list 2>/dev/null | grep -E '^(arviz|numba|mujoco|numpy) ' | tr -s ' \n' ' ')"
    mkdir -p ".venv-$end/kernels"
    NUMBA_CACHE_DIR=".venv-$end/kernels" ".venv-$end/bin/python" -m pytest -n "${JOBS:-2}" tests/compilation tests/physics \
        tests/render tests/posterior/test_compiled.py tests/structures/test_graph_posterior.py tests/interface/test_interface.py \
        tests/results/test_posterior.py tests/sampling/test_diagnostics.py
done
