"""The commands of ``omsm``: the module of each, its line of help, and the help of its options.

They are listed here so that ``omsm --help`` need not load their modules, which takes seconds.
"""

from typing import NamedTuple

from omsm_ros.messages import catalogue


class Word(NamedTuple):
    """One command: its ``module`` in this package, and its line of ``help``."""

    module: str
    help: str


# In the order of use.
_HELP = {
    "begin": """
doctor: check whether this computer can run a cell, with remedies
demo: calibrate and measure on the digital twin (needs ROS)
twin: write bags of the digital twin: a step test and a scan
completion: print a shell script that completes commands, options and file names
""",
    "recordings": """
record: record a device to a bag without ROS
inspect: list the streams and faults of a bag, or repair it
import: convert CSV, NumPy, MATLAB, HDF5 or TDMS files, or other ROS topics, to a bag
""",
    "dynamics of probe and machine": """
plan: write a step test for the machine, or scans of a part
identify: identify the transfer function from encoder to probe from a step test
verify: verify a calibration on a free path: errors and phase lags before and after
compare: test two calibrations for a change, or the repeatability of three or more
calset: combine calibrations at several positions of X, Z or B, for dynamics that vary
""",
    "latency": """
selfcal: estimate dynamics from scans of one part at different speeds or directions
reversal: estimate the probe latency from two scans with opposite spindle directions
latency: declare how much of a calibration's lag is probe latency, with a reason
""",
    "a scan": """
surface: show extent and slopes of a nominal surface, and whether probe and axes can follow
predict: predict the dynamic error of a motion and its maximum speed
align: estimate spindle centre and beam direction from a scan of a reference sphere
sources: evaluate error sources of the machine from a recording made for it
correct: correct a recorded scan: cloud, summary and report
adjust: adjust two or more scans of one part together: form, sources, verdict
report: write the report of a finished correction again
""",
    "the part": """
form: fit the pose and evaluate the form: deviation, Zernike terms, texture
compensate: compute offsets of the next cut from the measured form
difference: compare two measurements of one part: E_n, maps, verdict
spectrum: find spectral lines in scans of one part and their sources: part, vibration, aliased
    vibration, spindle
export: write a cloud or map in the format of another program
""",
    "many scans": """
batch: correct every bag of a folder; index page with outliers and trends
history: list past calibrations and measurements, and each machine's drift
""",
    "models of other systems": """
validate: simulate a model on another record and compare with its output
""",
}
# Modules that are not named as their only command; the demonstration is a node.
_MODULES = {
    "": ("demo",),
    "start": ("twin", "completion"),
    "recordings": ("record", "inspect", "import"),
    "calibration": ("verify", "compare", "calset"),
    "adjust": ("selfcal", "reversal", "latency", "align", "sources"),
    "form": ("surface", "compensate"),
    "correct": ("predict", "report"),
    "campaign": ("batch",),
    "identify": ("validate",),
}


_MODULE_OF = {word: module for module, words in _MODULES.items() for word in words}
TASKS: dict[str, dict[str, Word]] = {
    task: {name: Word(_MODULE_OF.get(name, name), help) for name, help in catalogue(text).items()}
    for task, text in _HELP.items()
}
WORDS = {name: word for words in TASKS.values() for name, word in words.items()}

# The help of an option that says more than the line of its declaration holds, by command and
# option, or by the option alone where several commands share it.
OPTIONS = catalogue("""
--aperture: area of the part to evaluate [m]: R, annulus:R,INNER, ellipse:A,B or rectangle:A,B (half
    lengths along x and y), each with ,X,Y of its middle if that is not the origin, or
    polygon:X,Y,X,Y…; default: that of the nominal surface, else around all points
--by-stamps: join probe and axes by their stamps: they share no trigger counter
--channel: channel of a file of several maps, by name or number from 0
--counter-offset: axes' trigger count minus the distance's trigger count
--dust: leave out no points (none), those that no neighbouring track confirms (isolated), or
    clusters of N points and less; default: isolated ones, which count against the tolerance
--fit: pose parameters to fit: 'auto', or of piston,tip,tilt,x,y,clocking,power; and unknown
    parameters of the shape: radius, radius_x, radius_y, conic, 'focal length', …
--namespace: namespace of the cell in a bag of several
--override: ignore a settings mismatch of the calibration (logged)
--placement: standard uncertainty of x and y of the part [m], and of its clocking [rad]; what the
    surface hardly determines is fixed with this uncertainty; default: a part placed by hand
--polarity: 1: the distance decreases as Z increases; -1: it increases
--stamp-tolerance: largest difference between the stamps of axes and probe for one trigger [s]
--topics: names of the cell's topics in the bag, if they are not the default ones
--unit: unit of files that do not state it, such as mm, or mm,nm
adjust --clamping: number of the clamping of each scan, where the part was taken off
adjust --clocking: angle by which the part is turned on the chuck in each scan [rad]
batch --scheduler: address of a Dask scheduler: tcp:// on this host, or tls://
calset placed: calibrations and their positions: x or z in metres, b in radians
compare more: three or more: test whether they repeat within their uncertainties
compensate --low-pass: cutoff wavelength, of which half is compensated [m]; shorter waves remain
compensate --previous: offsets of the last cut: their effect is checked, the new ones are added
correct --accuracy: largest expanded uncertainty of PV that the verdict accepts, k = 2 [m]
correct --delay: time from the probe's stamp to the middle of its exposure [s]
correct --pitch: measured pitch of Z: columns z_m,pitch_rad; needs abbe_arm in the geometry
correct --probe-latency: latency of the probe against X and C [s]; default: of the calibration
correct --sources: uncertainty sources of the machine, or JSON such as {"encoder_noise": 4e-10}
demo --experiment: repeat an experiment of the paper on the twin, Fig. 6 to 11; needs no ROS
difference --correlation-length: of errors of unknown form [m]; default: half the radius
difference --drift: standard deviation of the drift at the end of a scan [m]; default: from its
    sources, or estimated from the difference
difference --register: register each to the nominal surface first, as 'omsm form' does: 'auto', or
    of piston,tip,tilt,x,y,clocking,power
difference --uncertainty: standard uncertainty of the heights of a file that states none [m]
export --out: points: .csv .xyz .h5 .ply .pcd; a map: .x3p, .sdf, .dat (grid sag)
form --drawing: tolerances of ISO 10110-5, such as '3/0.5(0.2/0.1); RMSi < 20 nm'
history --add: add earlier calibrations or result folders to the catalogue
identify --accuracy: required expanded uncertainty of a height of that scan, k = 2 [m]
identify --equivalent-time: find a mode beyond half the sampling rate from the edges, if they are
    sharp and start at different fractions of a sample
identify --for: intended scan, a bag or a plan as CSV time_s,z_m, for the limits of the verdict;
    default: the paper's, 30 rpm over its mirror
identify --hold: behaviour of the input between samples: 'band-limited' for a measured input; the
    others, for a command signal, give a model instead of a calibration
identify --input: of a bag, 'encoder' or 'reference' for Z, then other axes that move the probe, as
    encoder,x,c; of a table, the input columns, A or A,B,C
identify --multisine: recording of a multisine on the fixed target: confirms the response without a
    model, and tells whether the machine is linear enough
identify --settings: settings of machine and probe that the calibration is valid for
identify recordings: bags of motions on a fixed target, or tables RECORD.csv, that one model
    describes
inspect --repair: copy the intact part of an MCAP bag to <bag>.repaired.mcap; the bag is unchanged
plan --count: number of steps up, and of steps down, from the middle
plan --dwell: time from edge to edge [s]; four times the dwell halves the undetected creep
plan --rate: rates of the probe [Hz], the preferred one first
plan --sharp: edges without ramps, for 'omsm identify --equivalent-time' alone, not to calibrate
plan what: a step test, a multisine that shows how linear the machine is, scans of a part, or speed
    and feed that avoid modes and lines
predict --limits: limits of servo, probe, spindle and axes, as config/limits.yaml; default: the
    paper's machine
record --set: parameters of the driver, such as sample_period=0.00025
selfcal --clocking: standard uncertainty of C between the scans [rad]; 10 if the part was re-mounted
selfcal --gain-uncertainty: relative standard uncertainty of the static gain
selfcal --harmonics: highest harmonic of the surface in a turn
selfcal --settings: settings of the calibration, used without a step test
spectrum --stop: remove this band from the heights, with zero phase; may be repeated
surface --probe-angle: largest angle to the surface normal at which the probe reads [rad]
surface what: show: extent, slopes, and whether probe and axes can follow
twin --radius: start radius of the spiral [m]; 0.002 scans for 20 s, 0.0127 the inner circle,
    0.01796 the whole ellipse of the mirror
twin --recordings: write the recordings that 'omsm sources' evaluates instead of step test and scan
""")
