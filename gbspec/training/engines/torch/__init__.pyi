from .engine import TorchEngine as TorchEngine
from .unroll import observe_rows as observe_rows
