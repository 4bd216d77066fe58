from .report import Identifiability as Identifiability
from .report import Inseparable as Inseparable
from .report import identifiability as identifiability
