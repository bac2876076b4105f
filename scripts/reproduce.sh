#!/usr/bin/env bash
# Measures again what docs/ reports of training: speed, then three arms × five seeds; or fine-tuned networks and what one
# might do instead. Goes on where it was interrupted.
set -euo pipefail

usage() {
    cat >&2 <<'END'
usage: DATA=cifar100.npz MESHES='[orange.glb]' PHOTOS=photos scripts/reproduce.sh gpu|cpu|harden|best [key=value ...]

In the root of the clone. gpu: experiments paper and fast; cpu: experiment cpu; harden: experiment harden from a network,
four arms and four other ways to robustness, three seeds each; best: experiment best, three seeds. Further settings of
conf/train.yaml go to every training run. From the environment:
  DATA      CIFAR-100 as data=npz reads it
  MESHES    scene.meshes, a list
  PHOTOS    a folder of photographs to score the networks on
  EXCLUDE   their sources that averages leave out; default []
  LAB       harden, best: a folder that scripts/lab.py wrote
  BASE      harden, best: the network to begin with; default pretrained/none
  DISTANCE  harden: of the random lights of the fourth arm, as far as the adversarial ones go; default 0.6
  DOCS      where the pages go; default docs
  RUNS      where the runs go; default runs/reproduce
  PYTHON    default python
END
    exit 2
}

benchmark() {
    "$python" -m benchmarks.training speed --data "$DATA" --meshes "$MESHES" --device "$device" \
        --csv "$docs/training_speed.csv"
}

sweep() {
    local experiment=$1 folder=$runs/$1
    shift
    "$python" -m train --multirun "experiment=$experiment" augment=none,random,adversarial seed=0,1,2,3,4 \
        data=npz "data.path=$DATA" "scene.meshes=$MESHES" "evaluate.photos=$PHOTOS" "train.device=$device" \
        "sweep=$folder" "$@"
    tables photographs "${EXCLUDE:-[]}" "$folder"/*/ | write_page "$experiment"
}

write_page() {
    {
        printf '# experiment=%s\n\n`scripts/reproduce.sh` trains these runs and writes this page; do not edit.\n\n' "$1"
        cat
    } >"$docs/runs_$1.md"
}

tables() {
    local photographs=$1 exclude=$2
    shift 2
    "$python" scripts/compare_runs.py "runs=[$(IFS=, && echo "${*%/}")]" "photographs=$photographs" "exclude=$exclude"
}

fine_tuned() {
    local experiment=$1
    shift
    "$python" -m train --multirun "experiment=$experiment" "train.init_from=${BASE:-pretrained/none}" seed=0,1,2 \
        data=npz "data.path=$DATA" "scene.meshes=$MESHES" "evaluate.photos={photographs:$PHOTOS,laboratory:$LAB}" \
        "sweep=$runs/$experiment" "$@"
}

best() {
    fine_tuned best "$@"
}

harden() {
    local pgd_images=1800 # so many take as long as the others' images, at three steps each
    fine_tuned harden augment=none,random,adversarial "$@"
    fine_tuned harden augment=random "augment.random_light.radius=${DISTANCE:-0.6}" "$@"
    fine_tuned harden augment=none train.augmentation=color_jitter,trivial_augment,augmix "$@"
    fine_tuned harden augment=none train.augmentation=pgd "train.images_per_epoch=$pgd_images" "$@"
}

compare_fine_tuned() {
    local folder=$runs/$1
    {
        printf '## The laboratory\n\n'
        tables laboratory [] "$folder"/*/
        printf '\n## Photographs\n\n'
        tables photographs "${EXCLUDE:-[]}" "$folder"/*/
    } | write_page "$1"
}

[[ -n ${DATA:-} && -n ${MESHES:-} && -n ${PHOTOS:-} ]] || usage
python=${PYTHON:-python} docs=${DOCS:-docs} runs=${RUNS:-runs/reproduce}

case ${1:-} in
gpu) device=cuda experiments=(paper fast) ;;
cpu) device=cpu experiments=(cpu) ;;
harden | best)
    [[ -n ${LAB:-} ]] || usage
    "$@"
    compare_fine_tuned "$1"
    exit
    ;;
*) usage ;;
esac
shift

benchmark
for experiment in "${experiments[@]}"; do
    sweep "$experiment" "$@"
done
