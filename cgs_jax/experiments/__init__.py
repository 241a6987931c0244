"""The paper's experiments: runs that are kept, numbers from them, figures and a report."""

from cgs_jax.experiments.report import write_report
from cgs_jax.experiments.study import FULL, QUICK, Budget, Progress, Study

__all__ = ["FULL", "QUICK", "Budget", "Progress", "Study", "write_report"]
