from .backend import agreed as agreed
from .beginning import restored_fit as restored_fit
from .constants import at_bounds as at_bounds
from .fit import train as train
from .unmoved import of_all as of_all
from .verdict import widening as widening
