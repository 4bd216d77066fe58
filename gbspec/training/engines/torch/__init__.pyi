from .control import planned as planned
from .engine import TorchEngine as TorchEngine
