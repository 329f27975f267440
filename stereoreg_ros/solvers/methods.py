"""The pose solvers by their names, as the paper's figures call them; one calling form for all."""

from __future__ import annotations

from typing import Final

from stereoreg_ros.solvers.ls_svd import solve_ls_svd, solve_ls_svd_dr
from stereoreg_ros.solvers.ls_tz import solve_ls_tz
from stereoreg_ros.solvers.maximum_likelihood import solve_maximum_likelihood
from stereoreg_ros.solvers.newton_raphson import solve_newton_raphson
from stereoreg_ros.solvers.pose_solution import PoseSolver

POSE_METHODS: Final[dict[str, PoseSolver]] = {
    "ls_svd": solve_ls_svd,
    "ls_svd_dr": solve_ls_svd_dr,
    "ls_tz": solve_ls_tz,
    "newton_raphson": solve_newton_raphson,
    "maximum_likelihood": solve_maximum_likelihood,
}
