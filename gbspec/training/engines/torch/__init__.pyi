from .engine import TorchEngine as TorchEngine
from .planning import planned as planned
