#!/bin/sh
# Run the tests of compiled code and of physics at both ends of the allowed versions of numba and mujoco.
# usage: scripts/test_bounds.sh [PYTHON]
set -eu
cd "$(dirname "$0")/.."
python=${1:-python3}
lowest=$(sed -nE 's/^ *"(numba|mujoco)>=([0-9.]+),.*/\1==\2.*/p' pyproject.toml)
for end in low high; do
    "$python" -m venv ".venv-$end"
    if [ "$end" = low ]; then wanted=$lowest; else wanted=""; fi
    # shellcheck disable=SC2086  # each is an argument of its own
    ".venv-$end/bin/python" -m pip install --quiet --disable-pip-version-check --upgrade -e '.[dev]' $wanted
    echo "== $end: $(".venv-$end/bin/python" -m pip list 2>/dev/null | grep -E '^(numba|mujoco|numpy) ' | tr -s ' \n' ' ')"
    mkdir -p ".venv-$end/kernels"
    NUMBA_CACHE_DIR=".venv-$end/kernels" ".venv-$end/bin/python" -m pytest -n 2 tests/compilation tests/physics tests/render \
        tests/posterior/test_compiled.py tests/structures/test_graph_posterior.py
done
