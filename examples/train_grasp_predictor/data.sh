#!/bin/bash
# Make free grasps for comparison: bash examples/train_grasp_predictor/data.sh OBJECTS OUT. OBJECTS is a folder of meshes
# OBJECT/clean.stl. Writes OUT/free and OUT/baseline; existing files are kept.
set -eu
objects=$1 out=$2
mkdir -p "$out/free" "$out/baseline"
for hand in barrett allegro; do
    for name in 003_cracker_box 005_tomato_soup_can 011_banana 024_bowl 037_scissors 048_hammer 056_tennis_ball \
            077_rubiks_cube koala spot; do
        mesh=$objects/$name/clean.stl
        [ -f "$out/free/$hand-$name.h5" ] ||
            graspd synth --hand $hand --object "$mesh" -n 160 -o "$out/free/$hand-$name.h5" || [ $? = 3 ] # exit code 3: fewer grasps than requested
        [ -f "$out/baseline/$hand-$name.h5" ] || graspd synth --hand $hand --object "$mesh" --method graspit \
            --option keep=20 --want candidates -n 192 -o "$out/baseline/$hand-$name.h5" || [ $? = 3 ]
    done
done
