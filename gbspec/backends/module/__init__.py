"""The standalone generated module: its text, and the class that this text defines."""

from gbspec.backends.module.layers import NetworkLayers, network_layers
from gbspec.backends.module.loader import load_module
from gbspec.backends.module.render import INTERFACE, class_name, generate

__all__ = ["INTERFACE", "NetworkLayers", "class_name", "generate", "load_module", "network_layers"]
