from .builder import Builder as Builder
from .clauses import ClauseRules as ClauseRules
from .parts import Children as Children
from .parts import Clause as Clause
from .parts import Names as Names
from .parts import tokens as tokens
