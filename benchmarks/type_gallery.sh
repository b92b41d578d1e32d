#!/usr/bin/env bash
# A Shadow grasp of each type of the GRASP taxonomy from three sides, for docs/explanation/grasps.md.
# usage: benchmarks/type_gallery.sh DATA_DIR OUT_DIR [TYPE]     DATA_DIR holds hands/ and objects/ (YCB)
set -euo pipefail
data=${1:?usage: type_gallery.sh DATA_DIR OUT_DIR [TYPE]}; out=${2:?usage: type_gallery.sh DATA_DIR OUT_DIR [TYPE]}
only=${3:-}
work=$(mktemp -d); trap 'rm -rf "$work"' EXIT
mkdir -p "$out"
shadow=$data/hands/shadow/shadow_hand_right.urdf
picture() { # type object [option ...]
    [ -z "$only" ] || [ "$only" = "$1" ] || return 0
    local mesh=${2#*_} # the sheet's title is the mesh's name
    mesh=$work/${mesh#tomato_}.stl
    cp "$data/objects/$2/clean.stl" "$mesh"
    graspd synth --hand "$shadow" --object "$mesh" --mass 0.1 --type "$1" -n 2 --budget 20 --seed 4 "${@:3}" \
        -o "$work/$1.h5" || [ $? = 3 ] # 3: fewer grasps than wanted
    graspd pictures "$work/$1.h5" --hand "$shadow" --object "$mesh" --three-sides --count 1 --size 150 \
        --palette -o "$out/$1.png"
}
picture large_diameter 005_tomato_soup_can
picture small_diameter 048_hammer
picture medium_wrap 006_mustard_bottle
picture prismatic_4_finger 003_cracker_box
picture prismatic_3_finger 003_cracker_box
picture prismatic_2_finger 003_cracker_box
picture palmar_pinch 037_scissors
picture power_disk 005_tomato_soup_can --approach-cone "0, 0, -1, 40" # from above
picture power_sphere 056_tennis_ball
picture precision_disk 056_tennis_ball
picture precision_sphere 056_tennis_ball
picture tripod 056_tennis_ball
picture fixed_hook 048_hammer
picture distal 006_mustard_bottle
picture lateral 037_scissors
picture sphere_4_finger 056_tennis_ball
picture quadpod 056_tennis_ball
picture sphere_3_finger 056_tennis_ball
picture ring 056_tennis_ball
