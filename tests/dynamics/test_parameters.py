"""What is believed of materials before a film, from YAML."""

from itertools import product

import numpy as np
import pytest

from derender.dynamics.parameters import Parameters, read_dynamics_prior
from derender.errors import DerenderError


def written(tmp_path, text):
    path = tmp_path / "materials.yaml"
    path.write_text(text)
    return path


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path):
    usual = read_dynamics_prior()
    told = read_dynamics_prior(written(tmp_path, "derender: 1\ndynamics:\n  friction: {uniform: [0.1, 0.3]}\n"))
    assert told.friction.support == (0.1, 0.3)
    assert told[1:] == usual[1:]
    parameters = Parameters(("a", "b"), np.array([1.0, 2.0]), told)
    draws = np.array([parameters.values(parameters.sample_prior(np.random.default_rng(k))) for k in range(200)])
    assert draws[:, 0].min() > 0.1 and draws[:, 0].max() < 0.3
    assert parameters.log_prior(np.array([np.log(0.4), 0.5, 0.0])) == -np.inf


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("friction: 0.3", "a fixed number"),
        ("restitution: {uniform: [0, 1.5]}", "restitution"),
        ("bounciness: {uniform: [0, 1]}", "unknown"),
    ],
)
def test_a_wrong_prior_is_one_line(tmp_path, line, fault):
    with pytest.raises(DerenderError, match=fault) as raised:
        read_dynamics_prior(written(tmp_path, f"dynamics:\n  {line}\n"))
    assert "materials.yaml:2" in str(raised.value).replace(", line ", ":")


def test_the_errors_prior_is_a_density_of_logarithms():
    """It integrates to one over a grid: without the Jacobian of the logarithm it would not."""
    prior = read_dynamics_prior()
    middle, spread = prior.log_scales()
    grid = [m + s * np.linspace(-6, 6, 11) for m, s in zip(middle, spread, strict=True)]
    cell = np.prod([axis[1] - axis[0] for axis in grid])
    total = sum(np.exp(prior.log_density_of_scales(np.array(point))) for point in product(*grid))
    assert abs(total * cell - 1) < 0.01
