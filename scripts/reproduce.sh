#!/usr/bin/env bash
# Repeats the training runs of docs/results.md and prints their tables. Finished runs are skipped, interrupted ones
# continue.
set -euo pipefail

usage() {
    cat >&2 <<'END'
usage: DATA=cifar100.npz MESHES='[orange.glb]' PHOTOS=photos scripts/reproduce.sh gpu|cpu|harden|best [key=value ...]

In the root of the clone. gpu: training speed, experiments paper and fast; cpu: training speed, experiment cpu; harden:
experiment harden from a network, four arms; best: experiment best, alone, with TrivialAugment, and six arms without
renders; three seeds each.
Further settings of pnb-train go to every training run. From the environment:
  DATA      CIFAR-100 as data=npz reads it
  MESHES    scene.meshes, a list
  PHOTOS    a folder of photographs to score the networks on
  EXCLUDE   their sources that averages leave out; default []
  LAB       harden, best: a folder that pnb-lab wrote
  BASE      harden, best: the network to begin with; default pretrained/none
  DISTANCE  harden: L2 norm of the fourth arm's random perturbations, that of the adversarial ones; default 0.6
  RUNS      where the runs go; default runs/reproduce
  PYTHON    default python
END
    exit 2
}

sweep() {
    local experiment=$1
    shift
    "$python" -m train --multirun "experiment=$experiment" data=npz "data.path=$DATA" "scene.meshes=$MESHES" \
        "sweep=$runs/$experiment" "$@"
}

tables() {
    local experiment=$1 photographs=$2 exclude=$3 folders=("$runs/$1"/*/)
    printf '\n## experiment=%s: %s\n\n' "$experiment" "$photographs"
    "$python" -m scripts.compare "runs=[$(IFS=, && echo "${folders[*]%/}")]" "photographs=$photographs" \
        "exclude=$exclude"
}

[[ -n ${DATA:-} && -n ${MESHES:-} && -n ${PHOTOS:-} ]] || usage
python=${PYTHON:-python} runs=${RUNS:-runs/reproduce} exclude=${EXCLUDE:-[]} command=${1:-}
from_network=("train.init_from=${BASE:-pretrained/none}" seed=0,1,2)
from_network+=("evaluate.photos={photographs:$PHOTOS,laboratory:${LAB:-}}")

case $command in
gpu) device=cuda experiments=(paper fast) ;;
cpu) device=cpu experiments=(cpu) ;;
harden | best) [[ -n ${LAB:-} ]] || usage ;;
*) usage ;;
esac
shift

case $command in
gpu | cpu)
    "$python" -m benchmarks.training speed --data "$DATA" --meshes "$MESHES" --device "$device" \
        --csv "$runs/training_speed.csv"
    for experiment in "${experiments[@]}"; do
        sweep "$experiment" augment=none,random,adversarial seed=0,1,2,3,4 "evaluate.photos=$PHOTOS" \
            "train.device=$device" "$@"
        tables "$experiment" photographs "$exclude"
    done
    exit
    ;;
best)
    sweep best "${from_network[@]}" "$@"
    sweep best train.augmentation=trivial_augment "${from_network[@]}" "$@"
    # The rivals, without renders: the same network, images, soup and seeds. For about best's minutes, no augmentation
    # has twice the images, and PGD, which takes three more passes for each, half of them.
    sweep best augment=none train.ranking=0 train.augmentation=none,color_jitter,trivial_augment,augmix \
        "${from_network[@]}" "$@"
    sweep best augment=none train.ranking=0 train.augmentation=none train.images_per_epoch=48000 "${from_network[@]}" "$@"
    sweep best augment=none train.ranking=0 train.augmentation=pgd train.images_per_epoch=12000 "${from_network[@]}" "$@"
    ;;
harden)
    sweep harden augment=none,random,adversarial "${from_network[@]}" "$@"
    sweep harden augment=random "augment.random_light.radius=${DISTANCE:-0.6}" "${from_network[@]}" "$@"
    ;;
esac
tables "$command" laboratory []
tables "$command" photographs "$exclude"
