from .backend import agreed as agreed
from .fit import train as train
from .verdict import widening as widening
