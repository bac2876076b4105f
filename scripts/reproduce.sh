#!/usr/bin/env bash
# Measures again what docs/ reports of training: speed, then three arms × five seeds. Goes on where it was interrupted.
set -euo pipefail

usage() {
    cat >&2 <<'END'
usage: DATA=cifar100.npz MESHES='[orange.glb]' PHOTOS=photos scripts/reproduce.sh gpu|cpu [key=value ...]

In the root of the clone. gpu: experiments paper and fast; cpu: experiment cpu. Further settings of conf/train.yaml go
to every training run. From the environment:
  DATA      CIFAR-100 as data=npz reads it
  MESHES    scene.meshes, a list
  PHOTOS    a folder of photographs to score the networks on
  EXCLUDE   their sources that averages leave out; default []
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
    local experiment=$1 page=$docs/runs_$1.md list
    shift
    list=$(IFS=, && echo "${*%/}")
    {
        printf '# experiment=%s\n\n`scripts/reproduce.sh` trains these runs and writes this page; do not edit.\n\n' \
            "$experiment"
        "$python" scripts/compare_runs.py "runs=[$list]" "exclude=${EXCLUDE:-[]}"
    } >"$page"
}

[[ -n ${DATA:-} && -n ${MESHES:-} && -n ${PHOTOS:-} ]] || usage
python=${PYTHON:-python} docs=${DOCS:-docs} runs=${RUNS:-runs/reproduce}

case ${1:-} in
gpu) device=cuda experiments=(paper fast) ;;
cpu) device=cpu experiments=(cpu) ;;
*) usage ;;
esac
shift

benchmark
for experiment in "${experiments[@]}"; do
    sweep "$experiment" "$@"
done
