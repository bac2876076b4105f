"""Find the camera and the lighting of a photograph."""

from train.cli import Command

main = Command(
    name="fit",
    settings="train.command_settings:FitSettings",
    about=__doc__,
    examples=["pnb-fit photograph=photo.jpg mask=mask.png mesh=orange.glb"],
)

if __name__ == "__main__":
    main()
