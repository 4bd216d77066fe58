from .unit import make as make
