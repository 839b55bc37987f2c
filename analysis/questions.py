"""The questions of docs/results.md, in its order, with the commands that train their runs."""

from .question import QUALITY, Question


def sweep(name: str, *more: str) -> str:
    """The command that trains a sweep."""
    return " ".join([f"python -m src.run --sweep {name} budget=short", *more])


def before(name: str, *more: str) -> str:
    """A sweep that was trained when density MLPs of the quick recipe had PyTorch's default initialisation."""
    return sweep(name, *more, "density.mlp.init=torch")


def comparison(title: str, *commands: str, key: str = "experiment", baseline: str = "quick_recipe") -> Question:
    """Compares the values of an option with a baseline. `experiment`: a name that packed runs have for what was set."""
    return Question(title, commands, ("scene_name", key), {key: baseline}, failures=True)


def density_start(title: str, field: str, rate: str, initial: str) -> Question:
    """Compares learning rates and initial densities of a density head with those of the quick recipe."""
    seeds = f"field={field} seed=0,1,2"
    return Question(
        title,
        (
            before("seeds", f"{seeds} train.rates.density=0.33,1.0"),
            before("seeds", f"{seeds} train.rates.density=1.0 density.initial=0.1,1.0"),
        ),
        ("scene_name", "train.rates.density", "density.initial"),
        {"train.rates.density": rate, "density.initial": initial},
        failures=True,
        other_baselines=() if rate == "1" else ({"train.rates.density": "1", "density.initial": initial},),
    )


SIGMOID = (
    "color.activations.qiren=sigmoid color.activations.qfgn=sigmoid color.direction_interval=signed hash.dense=true"
)
"""What `train=paper` was before the published code was followed."""

UPLOAD = "density.amplitude.registers=[5] density.amplitude.uploads=1"
TEN_SEEDS = "seed=0,1,2,3,4,5,6,7,8,9"
GROWN = "density.qiren_bypass.from_zero=false"
WIRES = "density.qiren_bypass.wire_per_feature=true qiren.spectral=1"
PIECES = (
    "qiren.gain=1", "qiren.center=false", "qiren.sum_layers=false", "qiren.init=uniform", "qiren.input_scale=1",
    "visibility.cameras=0", "shading=none", "color.direction_scale=1", "color.rates.qiren=1",
)  # fmt: skip
"""What takes one piece of the quick recipe away."""
LARGER = (
    "train.rays=128 proposal.samples=[256,96] proposal.final=48 proposal.max_resolutions=[128,256] "
    "proposal.log2_table_size=17",
)
ADDITIONS = ("qiren.gain=3", "qiren.statistics=first", "encoder.frequency_window=0.5", "ansatz=ternary")
LINEAR_PIECES = (PIECES[0], PIECES[1], PIECES[3], PIECES[4], PIECES[8])
BARE = "qiren.gain=1 qiren.center=false qiren.init=uniform"
RAW_MLPS = "color.directions=raw 'color.mlp={layers:3,width:20},{layers:2,width:58}'"

QUESTIONS = {
    "scenes": Question(
        "How good is a circuit head on each scene?",
        (sweep("scenes"),),
        ("scene_name", "field"),
        {"field": "classical"},
        values=(*QUALITY, "params.color", "params.density"),
    ),
    "start": comparison(
        "Which initial weights suit a density MLP beside a colour circuit?",
        sweep("seeds", "field=qcolor density.mlp.init=torch,he"),
        key="density.mlp.init",
        baseline="torch",
    ),
    "start_mlp": comparison(
        "Which initial weights suit a density MLP beside a colour MLP?",
        sweep("seeds", "field=classical density.mlp.init=torch,he"),
        key="density.mlp.init",
        baseline="torch",
    ),
    "recipe": comparison(
        "How much does each piece of the quick recipe help a quantum colour head?",
        *(sweep("recipe", piece) for piece in ("", *PIECES, *LARGER)),
    ),
    "recipe_density": comparison(
        "How much does each piece of the quick recipe help a quantum density head?",
        *(sweep("recipe", "field=qdensity", piece) for piece in ("", *PIECES[:5])),
    ),
    "recipe_linear": Question(
        "What does the quick recipe need where a circuit's colours are linear, as in the paper's code?",
        (
            *(sweep("recipe", "color.activations.qiren=linear", piece) for piece in ("", *LINEAR_PIECES, BARE)),
            sweep("recipe"),
        ),
        ("scene_name", "experiment", "color.activation", "color.qiren.gain"),
        {"experiment": "quick_recipe", "color.activation": "sigmoid"},
        failures=True,
        other_baselines=({"experiment": "no_gain", "color.activation": "linear"},),
    ),
    "recipe_more": comparison(
        "Which additions to the quick recipe would help?", *(sweep("recipe", piece) for piece in ("", *ADDITIONS))
    ),
    "seeds": Question(
        "How often does training collapse? Colour MLPs as in Nerfacto, and with raw directions and He initialisation",
        (sweep("seeds", "field=classical,qdensity color.directions=raw color.mlp.init=he"), sweep("seeds")),
        ("scene_name", "field", "color.mlp.init"),
        {"field": "classical", "color.mlp.init": "he"},
        failures=True,
        other_baselines=({"field": "classical", "color.mlp.init": "torch"},),
    ),
    "heads": Question(
        "Which density head pays beside an MLP for colour, and is it the circuit?",
        (
            sweep("heads"),
            sweep("heads", "density=mlp density.mlp.layers=1"),
            sweep("heads", "density=amplitude density.amplitude.unitary=identity"),
        ),
        ("scene_name", "density"),
        {"density": "2x64"},
        values=(*QUALITY, "params.density"),
        failures=True,
        other_baselines=({"density": "amplitude6-identity"},),
    ),
    "heads_unseen": Question(
        "Does an amplitude encoding for density pay on scenes on which nothing was chosen?",
        tuple(
            sweep("heads", heads, scene)
            for scene in (
                "scene=blender scene.path=CHAIR",
                "scene=colmap scene.path=KING scene.model=sparse scene.width=64",
                "scene=nerfstudio scene.path=TERRACE scene.width=64",
            )
            for heads in ("head@density=mlp,amplitude", "density=amplitude density.amplitude.unitary=identity")
        ),
        ("scene_name", "density"),
        {"density": "2x64"},
        values=(*QUALITY, "params.density"),
        other_baselines=({"density": "amplitude6-identity"},),
    ),
    "needs": Question(
        "Does needs=auto pay on scenes of different kinds?",
        tuple(
            f"python -m src.run -m needs=none,auto field=qcolor budget=short seed=0,1,2{scene}"
            for scene in (
                "",
                " scene=nerfstudio scene.path=FOX",
                " scene=blender scene.path=CHAIR",
                " scene=llff scene.path=FERN scene.width=64",
                " scene=colmap scene.path=KING scene.model=sparse scene.width=64",
                " scene=nerfstudio scene.path=TERRACE scene.width=64",
            )
        ),
        ("scene_name", "needs"),
        {"needs": "none"},
        values=(*QUALITY, "step_cpu_ms"),
    ),
    "heads_reupload": Question(
        "Does a circuit pay that the linear map cannot absorb?",
        (
            sweep("heads_control", f"{UPLOAD} density.amplitude.unitary=identity,circuit {TEN_SEEDS}"),
            sweep("heads_control", f"{UPLOAD} density.amplitude.unitary=local,random seed=0,1,2"),
            sweep("heads", f"head@density=mlp {TEN_SEEDS}"),
        ),
        ("scene_name", "density"),
        {"density": "amplitude5-identity-uploads=1"},
        values=(*QUALITY, "params.density"),
        other_baselines=({"density": "2x64"},),
    ),
    "heads_qiren": Question(
        "What limits QIREN as a density head?",
        (
            sweep("heads", "head@density=mlp,qiren"),
            sweep("heads", f"head@density=qiren_bypass {GROWN}"),
            sweep("heads", f"head@density=qiren_bypass {GROWN} {WIRES}"),
            sweep("heads", "density=mlp density.mlp.layers=3 density.mlp.width=8"),
        ),
        ("scene_name", "density"),
        {"density": "3x8"},
        values=(*QUALITY, "params.density"),
        other_baselines=({"density": "2x64"},),
    ),
    "heads_time": Question(
        "Do amplitude heads pay against an MLP that trains as long?",
        (
            sweep("heads", "head@density=mlp train.steps=1650,3000"),
            sweep("heads", "head@density=amplitude,reupload"),
            sweep("heads", "density=amplitude density.amplitude.unitary=identity"),
        ),
        ("scene_name", "density", "train.steps"),
        {"density": "2x64", "train.steps": "1650"},
        other_baselines=({"density": "2x64", "train.steps": "3000"},),
    ),
    "heads_color": Question(
        "Which colour head pays beside an MLP for density?",
        (
            sweep("heads_color"),
            sweep("heads_color", "color=amplitude color.amplitude.registers=[5]"),
            sweep("heads_color", "head@color=mlp color.mlp.layers=3 color.mlp.width=20"),
        ),
        ("scene_name", "color"),
        {"color": "2x58"},
        values=(*QUALITY, "params.color"),
        failures=True,
    ),
    "heads_photograph": Question(
        "Which head holds a photograph of 32 x 32 grey pixels best, and is it the circuit?",
        tuple(
            f"python -m src.run --sweep heads_photograph scene.path=camera,astronaut {more}"
            for more in (
                "train.rates.head=0.3,1.0",
                "train.rates.head=1.0 head=amplitude,qvf,qnerf,reupload,parallel,product "
                "++head.amplitude.unitary=identity",
            )
        ),
        ("scene_name", "head", "train.rates.head"),
        values=(*QUALITY, "params.head"),
    ),
    "heads_distance": Question(
        "Which head fits the signed distance of a shape best, and is it the circuit?",
        tuple(
            f"python -m src.run --sweep heads_distance {more}"
            for more in (
                "train.rates.head=1.0",
                "train.rates.head=0.1 head=siren",
                "train.rates.head=1.0 head=amplitude,qvf,qnerf,reupload,parallel,product "
                "++head.amplitude.unitary=identity",
            )
        ),
        ("scene.shape", "head", "train.rates.head"),
        metric="distance_error",
        within=0.0005,  # an eighth of the median error, as 0.5 dB is of a mean squared one
        values=("distance_error", "iou", "params.head"),
    ),
    "small_heads": Question(
        "Is a quantum colour head as good as MLPs of at most 700 parameters?",
        (
            sweep("small_heads"),
            sweep("small_heads", RAW_MLPS),
            "python -m src.run -m budget=short field=qcolor qiren=1L1S,1L2S seed=0,1,2",
        ),
        ("scene_name", "color", "color.directions", "color.mlp.init"),
        {"color": "1L2S"},
        values=(*QUALITY, "params.color"),
        failures=True,
    ),
    "control": Question(
        "Does the circuit help, or the recipe that comes with it?",
        (sweep("control"), sweep("control", "field=qcolor color.directions=raw color.mlp.init=torch")),
        ("scene_name", "color", "color.directions", "color.mlp.init"),
        {"color": "3x64", "color.directions": "raw", "color.mlp.init": "he"},
        values=(*QUALITY, "params.color"),
        failures=True,
    ),
    "control_density": Question(
        "Does a circuit for density help?",
        (
            sweep("control_density"),
            sweep("control_density", "field=classical density.mlp.init=he color.mlp.init=he color.directions=raw"),
            sweep("control_density", "field=qdensity,qboth density.mlp.init=torch"),
        ),
        ("scene_name", "field", "density.mlp.init", "color.mlp.init"),
        {"field": "classical", "density.mlp.init": "he", "color.mlp.init": "torch"},
        failures=True,
        other_baselines=({"field": "classical", "density.mlp.init": "torch", "color.mlp.init": "torch"},),
    ),
    "rates": comparison(
        "Which learning rate suits a colour circuit?",
        sweep("seeds", "field=qcolor train.rates.color=0.33,1.0"),
        key="train.rates.color",
        baseline="1",
    ),
    "rates_mlp": comparison(
        "Which learning rate suits a colour MLP?",
        before("seeds", "field=classical seed=0,1,2 train.rates.color=0.33,1.0"),
        key="train.rates.color",
        baseline="1",
    ),
    "rates_density": density_start(
        "Which learning rate and initial density suit a density circuit?", "qdensity", "0.33", "0.1"
    ),
    "rates_density_mlp": density_start(
        "Which learning rate and initial density suit a density MLP?", "classical", "1", "1"
    ),
    "directions": comparison(
        "How strongly should view directions be scaled?",
        before("directions", "train.rates.color=1.0"),
        key="color.direction_scale",
        baseline="1",
    ),
    "init": comparison(
        "How strongly should a circuit's outputs be amplified?",
        before(
            "init", "qiren.init=eighth qiren.gain=3,10 seed=0,1,2,3,4 color.direction_scale=1.0 train.rates.color=1.0"
        ),
        key="color.qiren.gain",
        baseline="3",
    ),
    "loss_curves": Question(
        "How do training and held-out loss develop?",
        (sweep("loss_curves"), "qnerf figures runs loss"),
        ("scene_name", "field"),
    ),
    "sampling": Question(
        "Where should rays be sampled?",
        (sweep("sampling"), "qnerf probe RUN rays", "qnerf figures runs sampling"),
        ("scene_name", "field", "sampler"),
    ),
    "proposals": Question(
        "How many samples do the proposal networks need on a ray?",
        (sweep("proposals"),),
        ("scene_name", "field", "sampler.samples"),
        {"field": "classical", "sampler.samples": "[128,64]"},
        values=(*QUALITY, "step_cpu_ms"),
        other_baselines=({"field": "qcolor", "sampler.samples": "[128,64]"},),
    ),
    "final_samples": Question(
        "Do half as many rendered samples suffice for a density circuit?",
        ("python -m src.run -m field=qdensity budget=short seed=0,1,2 proposal.final=32,16",),
        ("scene_name", "sampler.final"),
        {"sampler.final": "32"},
        values=(*QUALITY, "step_cpu_ms"),
        failures=True,
    ),
    "encoders": Question(
        "How should points be encoded?",
        (sweep("encoders"), "qnerf probe RUN encoding", "qnerf figures runs encodings"),
        ("scene_name", "field", "encoder"),
        values=(*QUALITY, "params.encoder", "params.density"),
    ),
    "poses": Question(
        "How much of the error of noisy poses does refinement recover?",
        (sweep("poses"),),
        ("scene_name", "field", "cameras", "pose_noise.rotation"),
    ),
    "rgb_width": Question(
        "How wide must an MLP of three layers be?",
        (sweep("rgb_width", "seed=0"), "qnerf figures runs width"),
        ("scene_name", "color"),
        values=(*QUALITY, "params.color"),
    ),
    "rgb_depth": Question(
        "How deep can a narrow MLP be?",
        (sweep("rgb_depth", "seed=0"), "qnerf figures runs depth"),
        ("scene_name", "color"),
        values=(*QUALITY, "params.color"),
    ),
    "deep": Question(
        "Why does a deep, narrow MLP collapse?",
        (
            before("deep"),
            before("deep", "color.mlp.init=torch train.rates.color=0.1,3.0 seed=0,1,2"),
            "qnerf probe RUN units",
        ),
        ("scene_name", "color", "color.mlp.init", "train.rates.color"),
        failures=True,
        units=True,
    ),
    "rgb_table": Question(
        "The paper's table of colour heads",
        (sweep("rgb_table"), sweep("rgb_mlps")),
        ("scene_name", "field", "color"),
        values=(*QUALITY, "params.color", "params.density"),
        paper=("rgb",),
    ),
    "rgb_paper": Question(
        "The paper's table of colour heads with the paper's recipe, 10,000 of its 30,000 steps",
        (
            "python -m src.run --sweep rgb_table train=paper train.steps=10000",
            "python -m src.run --sweep rgb_mlps seed=0,1,2 train=paper train.steps=10000",
        ),
        ("scene_name", "field", "color"),
        values=(*QUALITY, "params.color", "params.density"),
        paper=("rgb",),
    ),
    "both_table": Question(
        "The paper's table of both heads",
        (sweep("both_table"),),
        ("scene_name", "density", "color"),
        values=(*QUALITY, "params.color", "params.density"),
        paper=("both",),
    ),
    "both_paper": Question(
        "The paper's table of both heads with the paper's recipe, 10,000 of its 30,000 steps",
        ("python -m src.run --sweep both_table train=paper train.steps=10000",),
        ("scene_name", "density", "color"),
        values=(*QUALITY, "params.color", "params.density"),
        paper=("both",),
    ),
    "hash_table": Question(
        "The paper's hash tables",
        (sweep("hash_table"),),
        ("scene_name", "hash"),
        values=(*QUALITY, "params.encoder"),
        paper=("hash",),
    ),
    "pe_widths": Question(
        "How wide must a density MLP on a positional encoding be?",
        (sweep("pe_widths"),),
        ("scene_name", "density"),
        values=(*QUALITY, "params.density"),
    ),
    "hsv": Question(
        "The paper's colour study",
        (sweep("hsv"), "qnerf tables runs --paper hsv", "qnerf figures runs hsv"),
        ("scene_name", "field"),
        values=(*QUALITY, "params.density", "params.color"),
    ),
    "density_figure": Question(
        "The paper's figure of quantum density heads on a positional encoding",
        (sweep("density_figure"), "qnerf figures runs capacity_density"),
        ("scene_name", "density"),
        values=(*QUALITY, "params.density"),
    ),
    "density_rate": Question(
        "Two of these heads lose all density. Does a third of the learning rate save them?",
        (
            sweep(
                "density_figure",
                "density.qiren.layers=2,4 density.qiren.spectral=5,6 density.rates.qiren=0.33",
            ),
        ),
        ("scene_name", "density", "train.rates.density"),
    ),
    "density_pe": Question(
        "Is a quantum density head as good as an MLP of its size on a positional encoding?",
        (
            sweep("density_pe"),
            sweep("density_pe", "field=classical density.mlp.init=he"),
        ),
        ("scene_name", "density", "density.mlp.init"),
        {"density": "1L2S"},
        values=(*QUALITY, "params.density"),
        failures=True,
    ),
    "pe_paper": Question(
        "The same with the paper's recipe, 10,000 of its 30,000 steps",
        ("python -m src.run --sweep density_pe seed=0 train=paper train.steps=10000",),
        ("scene_name", "density"),
        {"density": "1L2S"},
        values=(*QUALITY, "params.density"),
    ),
    "density_sum": comparison(
        "Does such a head improve if it reads the sum of all its circuits?",
        sweep("density_pe", "field=qdensity qiren=1L2S density.qiren.sum_layers=false,true"),
        key="density.qiren.sum_layers",
        baseline="false",
    ),
    "ansatz": Question(
        "Which ansatz is best?",
        (sweep("ansatz", "qiren.ansatz=qiren,ry"), sweep("ansatz", "seed=0")),
        ("scene_name", "color.qiren.ansatz"),
        {"color.qiren.ansatz": "qiren"},
    ),
    "shots": Question(
        "How much quality do finite shots and noisy gates cost?",
        (
            before("shots"),
            "qnerf probe RUN shots=100,1000,10000",
            "qnerf probe RUN noise=depolarizing p=0.001,0.01,0.1",
        ),
        ("scene_name", "color"),
        values=("psnr", "params.color"),
        hardware=True,
    ),
    "noise": Question(
        "How much quality does noise cost at two re-uploadings? Few qubits, so that noise is simulated exactly",
        (before("noise"), "qnerf probe RUN noise=depolarizing p=0.001,0.01,0.1"),
        ("scene_name", "color.qiren.qubits"),
        values=("psnr", "params.color"),
        hardware=True,
    ),
    "paper_short": Question(
        "Two circuit heads with the paper's recipe and with the quick one, 1,500 steps each",
        (sweep("scenes", f"field=qboth train=quick,paper {SIGMOID}"),),
        ("scene_name", "train"),
        {"train": "paper"},
    ),
    "paper": Question(
        "The paper's recipe to its end, 30,000 steps",
        ("python -m src.run --sweep paper",),
        ("scene_name", "field"),
        {"field": "classical"},
        values=(*QUALITY, "step_ms", "train_s"),
        failures=True,
    ),
    "fog": Question(
        "Which colours of a circuit end as fog in the paper's recipe? (3,000 steps)",
        ("python -m src.run --sweep fog train.steps=3000",),
        ("scene_name", "color.activation"),
        {"color.activation": "linear"},
        failures=True,
        values=QUALITY,
    ),
    "paper_sigmoid": Question(
        "The paper's recipe with a sigmoid on a circuit's colours, 30,000 steps",
        (f"python -m src.run -m train=paper field=classical,qcolor {SIGMOID}",),
        ("scene_name", "field"),
        values=(*QUALITY, "step_ms", "train_s"),
    ),
}
"""Folder of packed runs -> question, in the order of the index."""
