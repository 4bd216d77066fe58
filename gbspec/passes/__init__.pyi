from .claims import check_claims as check_claims
from .contracts import with_contracts as with_contracts
from .examination import Examination as Examination
from .examination import examine as examine
from .override import with_values as with_values
from .steady import with_steady_start as with_steady_start
from .truth import with_truth as with_truth
