// SPDX-License-Identifier: Apache-2.0
// What a board feels: angles and a temperature; and the SCA100T-D01's analog outputs and SPI temperature.
#pragma once

#include <stdbool.h>
#include <stdint.h>

struct sensor {
    double angle[2];  // rad at the time `since`
    double rate[2];   // rad/s from then on
    double since;     // s
    double noise_rad; // rms within the sensor's own bandwidth
    double celsius;
    bool absent; // from the SPI bus
    double wander[2], wander_at[2];
    uint8_t command, bytes; // of the SPI transfer under way
    bool selected;
    double deselected_at;
};

double gaussian(void); // standard normal noise, for the converter too
void sensor_init(struct sensor *s);
void sensor_tilt(struct sensor *s, double now, double x, double y, double rate_x, double rate_y); // rad, rad/s
double sensor_angle(struct sensor *s, int axis, double now); // rad, with noise; `now` must not go back
double sensor_volts(struct sensor *s, int axis, double now); // `now` must not go back
void sensor_select(struct sensor *s, bool selected, double now);
uint8_t sensor_transfer(struct sensor *s, uint8_t in);
