from .remedies import differing as differing
from .report import Identifiability as Identifiability
from .report import Inseparable as Inseparable
from .report import by_one_trajectory as by_one_trajectory
from .report import identifiability as identifiability
