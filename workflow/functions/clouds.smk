# Clouds that the tables name in the place of photos.


def one_of(names):
    """A wildcard's constraint: one of some names; with none, nothing matches."""
    return "|".join(map(re.escape, names)) or "(?!)"


def cloud_of(kind):
    """Input function: the cloud of a scene or an object."""
    return lambda wildcards: own_file(kind, wildcards[kind], "cloud")


def cloud_path(kind):
    """The same, for a command line."""
    return lambda wildcards: shlex.quote(*cloud_of(kind)(wildcards))


def model_beside_cloud(wildcards):
    """Input function: the model of a scene that its cloud goes with."""
    folder = f"results/scenes/{wildcards.scene}"
    return f"{folder}/{'georeferenced' if lies_on_cloud(wildcards) else 'sparse'}"


def given_cameras_json(wildcards):
    """Input function: the JSON of given cameras; none where photos were laid on the cloud."""
    path = f"results/scenes/{wildcards.scene}/sparse.json"
    return [] if lies_on_cloud(wildcards) else path
