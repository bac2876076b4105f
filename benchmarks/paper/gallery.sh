#!/usr/bin/env bash
# Draws a picture of each kind of attack with pnb-attack. As in the paper, an
# attack may use any light, it ends when the network misclassifies, and there are
# no shadows. The captions have the predictions of the network.
#
#   OUT=gallery ORANGE=orange_sketchfab.glb benchmarks/paper/gallery.sh [key=value ...]
#
# Run it in the root of the clone. Every attack gets the further settings
# key=value of pnb-attack. PYTHON is the interpreter, by default python.
set -euo pipefail

as_in_the_paper=(
    attack.allow_negative=true
    attack.margin=0
    attack.quantized=false
    attack.max_steps=100
    attack.checks=false
    attack.verify=null
    renderer.shadows=false
)

# Attack with the settings $2, $3, ..., and keep the picture as gallery_$1.png.
picture() {
    local name=$1 folder
    shift
    folder=$(mktemp -d)
    "${PYTHON:-python}" -m scripts attack "out=$folder/out" "${as_in_the_paper[@]}" "$@"
    cp "$folder"/out/0_*/example_000.png "$OUT/gallery_$name.png"
    rm -r "$folder"
}

mkdir -p "${OUT:?name the folder of the pictures}"
lamp=('meshes=["solid:lamp:0"]' 'label=table lamp')
orange=("meshes=[{mesh: ${ORANGE:?name a mesh of an orange}, albedo_scale: 3}]" label=orange)
sky=(attack=skylight attack.skylight.step_size=0.2)
evening=(attack.skylight.zenith=75 attack.skylight.turbidity=8 'scene.backgrounds=[0.0]')
shape=(attack=geometry scene.vertices=10000)
three_views=(scene.views=3 attack.shared=true)

picture skylight "${orange[@]}" "${sky[@]}" "${evening[@]}" "$@"
picture skylight_lamp "${lamp[@]}" "${sky[@]}" "$@"
picture lighting "${lamp[@]}" attack=lighting "$@"
picture lighting_views "${lamp[@]}" attack=lighting "${three_views[@]}" "$@"
picture geometry "${lamp[@]}" "${shape[@]}" "$@"
picture geometry_views "${lamp[@]}" "${shape[@]}" "${three_views[@]}" \
    attack.geometry.radius=0.01 attack.geometry.step_size=0.001 "$@"
picture illusion "${lamp[@]}" "${shape[@]}" scene.views=2 attack.shared=true \
    attack.geometry.radius=null attack.geometry.step_size=0.001 \
    'target=[candle,joystick]' "$@"
picture albedo "${lamp[@]}" attack=albedo "$@"
picture pixels "${lamp[@]}" attack=pixels target=candle "$@"
picture lighting_geometry "${lamp[@]}" attack=lighting+geometry scene.vertices=10000 "$@"
