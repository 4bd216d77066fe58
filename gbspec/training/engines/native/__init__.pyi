from .engine import NativeEngine as NativeEngine
from .kernel import Kernel as Kernel
from .kernel import kernel_of as kernel_of
