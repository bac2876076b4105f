"""Find the camera and the lighting of a photograph."""

from train.cli import Command

examples = ["pnb-fit photograph=photo.jpg mask=mask.png mesh=orange.glb"]
main = Command("fit", "train.command_settings:FitSettings", __doc__, examples)

if __name__ == "__main__":
    main()
