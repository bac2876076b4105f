#!/usr/bin/env bash
# A picture of each kind of attack, by pnb-attack in the paper's manner: any light, an end where the network errs,
# no shadows. The captions hold the network's answers.
#   OUT=gallery ORANGE=orange_sketchfab.glb benchmarks/paper/gallery.sh [key=value ...]
# In the root of the clone. Further settings of conf/attack.yaml go to every attack; PYTHON is python by default.
set -euo pipefail

picture() {
    local name=$1 folder
    shift
    folder=$(mktemp -d)
    "${PYTHON:-python}" -m scripts.attack "out=$folder/out" attack.allow_negative=true attack.margin=0 attack.rounded=false \
        attack.max_steps=100 attack.checks=false attack.verify=null renderer.shadows=false "$@"
    cp "$folder"/out/0_*/example_000.png "$OUT/gallery_$name.png"
    rm -r "$folder"
}

mkdir -p "${OUT:?name the folder of the pictures}"
lamp=('scene.meshes=["solid:lamp:0"]' 'label=table lamp')
orange=("scene.meshes=[{mesh: ${ORANGE:?name a mesh of an orange}, albedo_scale: 3}]" label=orange)
evening=(attack.skylight.zenith=75 attack.skylight.turbidity=8 'scene.backgrounds=[0.0]')
shape=(attack=geometry scene.vertices=10000)
three_views=(scene.views=3 attack.shared=true)

picture skylight "${orange[@]}" attack=skylight attack.skylight.step_size=0.2 "${evening[@]}" "$@"
picture skylight_lamp "${lamp[@]}" attack=skylight attack.skylight.step_size=0.2 "$@"
picture lighting "${lamp[@]}" attack=lighting "$@"
picture lighting_views "${lamp[@]}" attack=lighting "${three_views[@]}" "$@"
picture geometry "${lamp[@]}" "${shape[@]}" "$@"
picture geometry_views "${lamp[@]}" "${shape[@]}" attack.geometry.radius=0.01 attack.geometry.step_size=0.001 \
    "${three_views[@]}" "$@"
picture illusion "${lamp[@]}" "${shape[@]}" attack.geometry.radius=null attack.geometry.step_size=0.001 \
    scene.views=2 attack.shared=true 'target=[candle,joystick]' "$@"
picture albedo "${lamp[@]}" attack=albedo "$@"
picture pixels "${lamp[@]}" attack=pixels target=candle "$@"
picture lighting_geometry "${lamp[@]}" attack=lighting+geometry scene.vertices=10000 "$@"
