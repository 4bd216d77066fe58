from .claims import check_claims as check_claims
from .contracts import with_contracts as with_contracts
from .delays import least_value as least_value
from .examination import Examination as Examination
from .examination import examine as examine
from .override import with_values as with_values
from .structure import with_structure as with_structure
from .truth import with_truth as with_truth
