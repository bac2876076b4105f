#!/usr/bin/env bash
# Repeats the training runs of docs/results.md and prints their tables. Finished
# runs are skipped, and interrupted runs continue.
set -euo pipefail

usage() {
    cat >&2 <<'END'
usage: DATA=cifar100.npz MESHES='[orange.glb]' PHOTOS=photos scripts/reproduce.sh gpu|cpu|harden|patterns [key=value ...]

Run it in the root of the clone.
  gpu       training speed, and the experiments paper and fast, with five seeds
  cpu       training speed, and the experiment cpu, with five seeds
  harden    the experiment harden from a network: four methods with three seeds
  patterns  the experiment patterns, alone and with TrivialAugment, and six methods
            without renders, with three seeds

Every training run gets the further settings key=value of pnb-train.

These are read from the environment:
  DATA      CIFAR-100, as data=npz reads it
  MESHES    meshes, a list
  PHOTOS    a folder of photographs on which the networks are scored
  LAB       harden, patterns: a folder that pnb-lab wrote
  BASE      harden, patterns: the network to start from; default pretrained/none
  DISTANCE  harden: L2 norm of the random perturbations of the fourth method. It is
            the norm of the adversarial perturbations; default 0.6
  RUNS      folder of the runs; default runs/reproduce
  PYTHON    the interpreter; default python
END
    exit 2
}

# Train the runs of experiment $1 with the settings $2, $3, ...
sweep() {
    local experiment=$1
    shift
    "$python" -m train --multirun "experiment=$experiment" data=npz "data.path=$DATA" \
        label=orange "meshes=$MESHES" "sweep=$runs/$experiment" "$@"
}

# Print the tables of experiment $1.
tables() {
    local experiment=$1
    local folders=("$runs/$experiment"/*/)
    printf '\n## experiment=%s\n\n' "$experiment"
    local list
    list=$(IFS=, && echo "${folders[*]%/}")
    "$python" -m scripts.compare "runs=[$list]" -v
}

[[ -n ${DATA:-} && -n ${MESHES:-} && -n ${PHOTOS:-} ]] || usage
python=${PYTHON:-python}
runs=${RUNS:-runs/reproduce}
command=${1:-}
from_network=("network=${BASE:-pretrained/none}" seed=0,1,2)
from_network+=("photos={photographs:$PHOTOS,laboratory:${LAB:-}}")

case $command in
gpu)
    device=cuda
    experiments=(paper fast)
    ;;
cpu)
    device=cpu
    experiments=(cpu)
    ;;
harden | patterns) [[ -n ${LAB:-} ]] || usage ;;
*) usage ;;
esac
shift

case $command in
gpu | cpu)
    "$python" -m benchmarks.training speed --data "$DATA" --meshes "$MESHES" --device "$device" \
        --csv "$runs/training_speed.csv"
    for experiment in "${experiments[@]}"; do
        sweep "$experiment" augment=none,random,adversarial seed=0,1,2,3,4 "photos=$PHOTOS" \
            "train.device=$device" "$@"
        tables "$experiment"
    done
    exit
    ;;
patterns)
    sweep patterns "${from_network[@]}" "$@"
    sweep patterns train.augmentation=trivial_augment "${from_network[@]}" "$@"
    # The baselines have no renders, but the same network, images, model soup and
    # seeds. To train for about as many minutes as patterns, the method without
    # augmentation gets twice the images. PGD takes three additional passes for
    # each image, and gets half of the images.
    without_renders=(augment=none train.ranking_weight=0)
    sweep patterns "${without_renders[@]}" \
        train.augmentation=none,color_jitter,trivial_augment,augmix "${from_network[@]}" "$@"
    sweep patterns "${without_renders[@]}" train.augmentation=none train.images_per_epoch=48000 \
        "${from_network[@]}" "$@"
    sweep patterns "${without_renders[@]}" train.augmentation=pgd train.images_per_epoch=12000 \
        "${from_network[@]}" "$@"
    ;;
harden)
    sweep harden augment=none,random,adversarial "${from_network[@]}" "$@"
    sweep harden augment=random "augment.random_light.radius=${DISTANCE:-0.6}" "${from_network[@]}" "$@"
    ;;
esac
tables "$command"
