from .layers import NetworkLayers as NetworkLayers
from .layers import NetworkNumbers as NetworkNumbers
from .layers import network_layers as network_layers
from .layers import network_numbers as network_numbers
from .loader import load_module as load_module
from .render import INTERFACE as INTERFACE
from .render import class_name as class_name
from .render import generate as generate
