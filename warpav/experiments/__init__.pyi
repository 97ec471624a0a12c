"""What others use of this package; it is imported when it is first used."""

from warpav.experiments._experiment import run_study as run_study
from warpav.experiments._method_figures import draw_method_figure as draw_method_figure
from warpav.experiments._rescore import check_rescored_options as check_rescored_options
from warpav.experiments._rescore import config_file as config_file
from warpav.experiments._rescore import folder_name as folder_name
from warpav.experiments._rescore import plan_panel as plan_panel
from warpav.experiments._rescore import plan_rescore as plan_rescore
from warpav.experiments._rescore import run_rescores as run_rescores
from warpav.experiments._rows import ROWS as ROWS
from warpav.experiments._rows import filled_page as filled_page
from warpav.experiments._rows import read_rows as read_rows
from warpav.experiments._rows import write_rows as write_rows
from warpav.experiments._scene_figures import RIG_NUMBERS as RIG_NUMBERS
from warpav.experiments._scene_figures import draw_figure as draw_figure
from warpav.experiments._scene_figures import scene_store_heat_maps as scene_store_heat_maps
from warpav.experiments._scene_statistics import scene_statistics as scene_statistics
from warpav.experiments._study import find_study as find_study
from warpav.experiments.bench._run import BenchOptions as BenchOptions
from warpav.experiments.bench._run import run_bench as run_bench
