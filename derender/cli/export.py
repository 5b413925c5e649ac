"""derender export: a scene for other programs."""

import click

from derender.cli import options
from derender.cli.options import Talk


@click.command()
@click.argument("scene", metavar="SCENE-or-DIR")
@options.output(
    "The suffix is the format: .glb .obj .xml (MuJoCo) .urdf .json (BOP) .rrd (rerun).", "FILE", required=True
)
@options.quiet
def command(scene: str, output: str, talk: Talk) -> None:
    """Write a scene file, or the most probable scene of a folder written by `derender infer`, for other programs.

    .glb keeps the tree of the scene graph; .obj comes with its materials (.mtl); .xml is the model that `derender
    simulate` runs; .urdf has a link for each solid; .json is BOP's scene_gt.json, with models_info.json and
    scene_camera.json beside it. All but BOP's, which is in the camera's axes, have z up and the origin on the floor
    (glTF: y up). .rrd is a log that rerun plays (pip install 'derender[rerun]'), in the camera's axes: of a folder with
    its image, and its chains draw by draw.

    \b
    Examples:
        derender export scene.yaml -o scene.glb
        derender export results/ -o scene.xml && python -m mujoco.viewer --mjcf scene.xml
        derender export results/ -o chains.rrd && rerun chains.rrd
        derender sample -o - | derender export - -o scene.glb
    """
    from derender.cli.reading import read_observation, read_scene

    found = read_scene(scene)
    if output.lower().endswith(".rrd"):
        from derender.report.export import write_rrd

        image, camera = read_observation(scene) or (None, found.camera)
        write_rrd(output, found.graph, found.posterior, image, camera)
        talk.say(f"wrote {output}")
        return
    from derender.report.export import export_scene

    for path in export_scene(found.graph, output, found.camera):
        talk.say(f"wrote {path}")
