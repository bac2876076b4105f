#!/usr/bin/env bash
# Measures again what docs/ reports of training: speed, then three arms × five seeds; or hardened networks and what one
# might do instead. Goes on where it was interrupted.
set -euo pipefail

usage() {
    cat >&2 <<'END'
usage: DATA=cifar100.npz MESHES='[orange.glb]' PHOTOS=photos scripts/reproduce.sh gpu|cpu|harden [key=value ...]

In the root of the clone. gpu: experiments paper and fast; cpu: experiment cpu; harden: experiment harden from a network,
four arms and four other ways to robustness, three seeds each. Further settings of conf/train.yaml go to every training
run. From the environment:
  DATA      CIFAR-100 as data=npz reads it
  MESHES    scene.meshes, a list
  PHOTOS    a folder of photographs to score the networks on
  EXCLUDE   their sources that averages leave out; default []
  LAB       harden: a folder that scripts/lab.py wrote
  BASE      harden: the network to begin with; default pretrained/none
  DISTANCE  harden: of the random lights of the fourth arm, as far as the adversarial ones go; default 0.6
  DOCS      where the pages go; default docs
  RUNS      where the runs go; default runs/reproduce
  PYTHON    default python
END
    exit 2
}

benchmark() {
    "$python" scripts/benchmark_training.py data=npz "data.path=$DATA" "scene.meshes=$MESHES" "train.device=$device" \
        "out=$docs/performance.md"
}

sweep() {
    local experiment=$1 folder=$runs/$1
    shift
    "$python" -m train --multirun "experiment=$experiment" augment=none,random,adversarial seed=0,1,2,3,4 \
        data=npz "data.path=$DATA" "scene.meshes=$MESHES" "evaluate.photos=$PHOTOS" "train.device=$device" \
        "sweep=$folder" "$@"
    compare "$experiment" "$folder"/*/
}

compare() {
    local experiment=$1 page=$docs/runs_$1.md
    shift
    {
        printf '# experiment=%s\n\n`scripts/reproduce.sh` trains these runs and writes this page; do not edit.\n\n' \
            "$experiment"
        tables photographs "${EXCLUDE:-[]}" "$@"
    } >"$page"
}

tables() {
    local photographs=$1 exclude=$2
    shift 2
    "$python" scripts/compare_runs.py "runs=[$(IFS=, && echo "${*%/}")]" "photographs=$photographs" "exclude=$exclude"
}

hardened() {
    "$python" -m train --multirun experiment=harden "train.init_from=${BASE:-pretrained/none}" seed=0,1,2 \
        data=npz "data.path=$DATA" "scene.meshes=$MESHES" "evaluate.photos={photographs:$PHOTOS,laboratory:$LAB}" \
        "sweep=$runs/harden" "$@"
}

harden() {
    local pgd_images=1800 # so many take as long as the others' images, at three steps each
    hardened augment=none,random,adversarial "$@"
    hardened augment=random "augment.random.radius=${DISTANCE:-0.6}" "$@"
    hardened augment=none train.distortion=color_jitter,trivial_augment,augmix "$@"
    hardened augment=none train.distortion=pgd "train.images_per_epoch=$pgd_images" "$@"
    {
        printf '# experiment=harden\n\n`scripts/reproduce.sh` trains these runs and writes this page; do not edit.\n'
        printf '\n## The laboratory\n\n'
        tables laboratory [] "$runs"/harden/*/
        printf '\n## Photographs\n\n'
        tables photographs "${EXCLUDE:-[]}" "$runs"/harden/*/
    } >"$docs/runs_harden.md"
}

[[ -n ${DATA:-} && -n ${MESHES:-} && -n ${PHOTOS:-} ]] || usage
python=${PYTHON:-python} docs=${DOCS:-docs} runs=${RUNS:-runs/reproduce}

case ${1:-} in
gpu) device=cuda experiments=(paper fast) ;;
cpu) device=cpu experiments=(cpu) ;;
harden)
    [[ -n ${LAB:-} ]] || usage
    shift
    harden "$@"
    exit
    ;;
*) usage ;;
esac
shift

benchmark
for experiment in "${experiments[@]}"; do
    sweep "$experiment" "$@"
done
