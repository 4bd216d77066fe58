from . import diagram as diagram
from . import eigenvalues as eigenvalues
from . import initial_states as initial_states
from . import plane as plane
from . import profile as profile
