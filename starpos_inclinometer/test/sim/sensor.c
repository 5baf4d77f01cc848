// SPDX-License-Identifier: Apache-2.0
#include "sensor.h"

#include <math.h>
#include <stdlib.h>

#include "complain.h"

#define SUPPLY_V 5.0
#define VOLTS_PER_G 4.0
#define BANDWIDTH_HZ 18.0 // -3 dB
#define RWTR 0x08
#define MIN_DESELECTED_S 150e-6

double gaussian(void)
{
    double u = (random() + 1.0) / (RAND_MAX + 2.0), v = (random() + 1.0) / (RAND_MAX + 2.0);
    return sqrt(-2 * log(u)) * cos(2 * M_PI * v);
}

void sensor_init(struct sensor *s)
{
    *s = (struct sensor){.noise_rad = 0.0042 * M_PI / 180, .celsius = 20, .deselected_at = -1};
}

static double angle(const struct sensor *s, int axis, double now)
{
    return s->angle[axis] + s->rate[axis] * (now - s->since);
}

void sensor_tilt(struct sensor *s, double now, double x, double y, double rate_x, double rate_y)
{
    s->angle[0] = x;
    s->angle[1] = y;
    s->rate[0] = rate_x;
    s->rate[1] = rate_y;
    s->since = now;
}

// Noise of one pole at the bandwidth: a Gauss-Markov process, taken over exactly from one time to the next.
static double wander(struct sensor *s, int axis, double now)
{
    double kept = exp(-2 * M_PI * BANDWIDTH_HZ * (now - s->wander_at[axis]));
    s->wander[axis] = s->wander[axis] * kept + sqrt(1 - kept * kept) * gaussian();
    s->wander_at[axis] = now;
    return s->wander[axis] * s->noise_rad;
}

double sensor_angle(struct sensor *s, int axis, double now)
{
    return angle(s, axis, now) + wander(s, axis, now);
}

double sensor_volts(struct sensor *s, int axis, double now)
{
    double volts = SUPPLY_V / 2 + VOLTS_PER_G * sin(sensor_angle(s, axis, now));
    return fmin(fmax(volts, 0), SUPPLY_V);
}

void sensor_select(struct sensor *s, bool selected, double now)
{
    if (selected && !s->selected && now - s->deselected_at < MIN_DESELECTED_S)
        complain("SCA100T selected again within 150 us");
    if (!selected && s->selected) {
        if (s->bytes != 2)
            complain("SCA100T transfer of another length than 16 bits");
        s->deselected_at = now;
    }
    s->selected = selected;
    s->bytes = 0;
}

uint8_t sensor_transfer(struct sensor *s, uint8_t in)
{
    if (s->bytes++ == 0)
        s->command = in;
    if (s->absent)
        return 0xFF; // MISO is pulled up
    if (s->bytes == 1)
        return 0;
    if (s->command != RWTR)
        complain("SCA100T command that is not RWTR");
    return lround(fmin(fmax(197 - 1.083 * s->celsius, 0), 255));
}
