from .estimate import predictions as predictions
from .solutions import ORIGINS as ORIGINS
from .solutions import Prediction as Prediction
from .solutions import extrapolated as extrapolated
from .solutions import learned_positions as learned_positions
from .solutions import learned_start as learned_start
from .solutions import mean_prediction as mean_prediction
from .solutions import predict as predict
