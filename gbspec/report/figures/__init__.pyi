from . import diagram as diagram
from . import eigenvalues as eigenvalues
from . import fit as fit
from . import functions as functions
from . import initial_states as initial_states
from . import plane as plane
from . import profile as profile
from . import summary as summary
