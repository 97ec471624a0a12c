"""What others use of this package; it is imported when it is first used."""

from warpav.thesis._constraints import BoundsAndSpacing as BoundsAndSpacing
from warpav.thesis._descent import AdamW as AdamW
from warpav.thesis._descent import Descent as Descent
from warpav.thesis._descent import affordable_iterations as affordable_iterations
from warpav.thesis._descent import descent_camera_renders as descent_camera_renders
from warpav.thesis._detector_gradient import DetectorGradient as DetectorGradient
from warpav.thesis._losses import AngularCoverage as AngularCoverage
from warpav.thesis._losses import DetectedArea as DetectedArea
from warpav.thesis._losses import InFrameRotation as InFrameRotation
from warpav.thesis._losses import ObjectVisibility as ObjectVisibility
from warpav.thesis._losses import SurfaceBlockage as SurfaceBlockage
from warpav.thesis._segregation import BatchChooser as BatchChooser
from warpav.thesis._segregation import Segregation as Segregation
from warpav.thesis._segregation import areas_around as areas_around
from warpav.thesis._segregation import assign_to_nearest_cameras as assign_to_nearest_cameras
from warpav.thesis._segregation import cameras_of as cameras_of
from warpav.thesis._segregation import choose_orientations as choose_orientations
from warpav.thesis._segregation import nearest_cameras as nearest_cameras
from warpav.thesis._starts import evaluate_starts as evaluate_starts
from warpav.thesis._tables import WARNING as WARNING
from warpav.thesis._tables import thesis_table as thesis_table
