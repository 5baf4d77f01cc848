// SPDX-License-Identifier: Apache-2.0
// One plate for camera, lens and board. Along x: board, camera's tripod screw, mount, lens's foot. The camera looks along x.
// openscad -o plate.stl plate.scad     writes the mesh; other sizes by -D camera_x_mm=110, or by editing these.

length_mm = 240;
width_mm = 90;
thickness_mm = 15;
corner_mm = 8;

// Centres of the holes along x; all but the board's lie on the middle line. Measure your camera and lens.
camera_x_mm = 120;
mount_x_mm = 160;
lens_x_mm = 205;
// Clearance of a 1/4-20 and of a 3/8-16 screw, and their heads in the lower face.
camera_hole_mm = 6.6;
camera_head_mm = 12;
camera_head_depth_mm = 8;
mount_hole_mm = 9.8;
// Slots, so that screws meet cameras of other sizes.
slot_mm = 10;

// The board stands on four posts, cast or milled in one piece with the plate; the holes are cores of M3 threads.
board_x_mm = 50;
board_spacing_x_mm = 70;
board_spacing_y_mm = 70;
post_mm = 8;
post_height_mm = 6;
thread_mm = 2.5;
thread_depth_mm = 12;

$fn = 32;
// Cuts go this far beyond a face.
beyond_mm = 1;

module slot(diameter, height) {
    hull() for (side = [-1, 1]) translate([side * slot_mm / 2, 0, 0]) cylinder(d = diameter, h = height);
}

module screw(x) {
    translate([x, 0, -beyond_mm]) slot(camera_hole_mm, thickness_mm + 2 * beyond_mm);
    translate([x, 0, -beyond_mm]) slot(camera_head_mm, camera_head_depth_mm + beyond_mm);
}

module at_posts() {
    for (x = [-1, 1], y = [-1, 1])
        translate([board_x_mm + x * board_spacing_x_mm / 2, y * board_spacing_y_mm / 2, 0]) children();
}

difference() {
    union() {
        translate([corner_mm, corner_mm - width_mm / 2, 0]) linear_extrude(thickness_mm)
            offset(r = corner_mm) square([length_mm - 2 * corner_mm, width_mm - 2 * corner_mm]);
        at_posts() cylinder(d = post_mm, h = thickness_mm + post_height_mm);
    }
    screw(camera_x_mm);
    screw(lens_x_mm);
    translate([mount_x_mm, 0, -beyond_mm]) cylinder(d = mount_hole_mm, h = thickness_mm + 2 * beyond_mm);
    at_posts() translate([0, 0, thickness_mm + post_height_mm - thread_depth_mm])
        cylinder(d = thread_mm, h = thread_depth_mm + beyond_mm);
}
