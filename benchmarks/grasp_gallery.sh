#!/usr/bin/env bash
# Grasps of all kinds of objects from three sides, for docs/explanation/grasps.md.
# usage: benchmarks/grasp_gallery.sh DATA_DIR OUT_DIR     DATA_DIR holds hands/ and objects/ (YCB)
set -euo pipefail
data=${1:?usage: grasp_gallery.sh DATA_DIR OUT_DIR}; out=${2:?usage: grasp_gallery.sh DATA_DIR OUT_DIR}
work=$(mktemp -d); trap 'rm -rf "$work"' EXIT
mkdir -p "$out"
picture() { # prefix hand mesh name
    cp "$3" "$work/$4.stl" # the sheet's title is the mesh's name
    graspd synth --hand "$2" --object "$work/$4.stl" -n 8 --seed 4 -o "$work/$4.h5" || [ $? = 3 ] # 3: fewer grasps than wanted
    graspd pictures "$work/$4.h5" --hand "$2" --object "$work/$4.stl" --three-sides --count 4 --size 200 \
        -o "$out/$1-$4.png"
}
allegro=$data/hands/allegro/allegro_hand_right.urdf
for object in 024_bowl 025_mug 037_scissors 048_hammer 056_tennis_ball 035_power_drill 003_cracker_box; do
    picture allegro "$allegro" "$data/objects/$object/clean.stl" "$object"
done
picture allegro "$allegro" "$data/bad/thin_sheet_1mm.stl" plate_1mm
picture barrett "$data/hands/barrett_bh280/bh280.urdf" "$data/objects/061_foam_brick/clean.stl" 061_foam_brick
picture shadow "$data/hands/shadow/shadow_hand_right.urdf" "$data/objects/011_banana/clean.stl" 011_banana
