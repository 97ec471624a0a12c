"""What others use of this package; it is imported when it is first used."""

from warpav.view.figures._clouds import sphere as sphere
from warpav.view.figures._clouds import stages as stages
from warpav.view.figures._clouds import window_filter as window_filter
from warpav.view.figures._convergence import loss_figure as loss_figure
from warpav.view.figures._convergence import search_figure as search_figure
from warpav.view.figures._from_above import further_figure as further_figure
from warpav.view.figures._from_above import top_view_figure as top_view_figure
from warpav.view.figures._images import contact_sheet as contact_sheet
from warpav.view.figures._images import detections_sheet as detections_sheet
from warpav.view.figures._images import image_types as image_types
from warpav.view.figures._images import own_body_tinted as own_body_tinted
from warpav.view.figures._rigs import OptimisedRig as OptimisedRig
from warpav.view.figures._rigs import before_and_after as before_and_after
from warpav.view.figures._rigs import heat_maps as heat_maps
from warpav.view.figures._rigs import highest_rig as highest_rig
from warpav.view.figures._rigs import mount_surface_stages as mount_surface_stages
from warpav.view.figures._rigs import without_and_with_constraints as without_and_with_constraints
from warpav.view.figures._statistics import detection_curves as detection_curves
from warpav.view.figures._statistics import differences_figure as differences_figure
from warpav.view.figures._statistics import front_figure as front_figure
from warpav.view.figures._statistics import recall_figure as recall_figure
from warpav.view.figures._statistics import reliability_diagram as reliability_diagram
from warpav.view.figures._statistics import sensitivity_figure as sensitivity_figure
from warpav.view.figures._style import checked_figure as checked_figure
from warpav.view.figures._style import figure_bytes as figure_bytes
from warpav.view.figures._style import save_figure as save_figure
