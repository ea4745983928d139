"""Error budgets: a tracer's scores with truth in place of one stage's result at a time, and of all."""

from .run import BudgetConfig as BudgetConfig
from .run import run_budget as run_budget
from .table import console_table as console_table
