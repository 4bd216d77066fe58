"""The parts of a generated module that are the same for every model: real modules, joined by `module.render`."""
