from .unit import make as make
from .units import base_unit as base_unit
