from .importing import import_petab as import_petab
