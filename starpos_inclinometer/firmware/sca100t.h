// SPDX-License-Identifier: Apache-2.0
// The sensor's SPI side, of which only the temperature is used (data sheet SCA100T series, Murata 8261800 rev. B2).
#pragma once

#include <stdbool.h>
#include <stdint.h>

// The temperature's counts, (counts - 197) / -1.083 deg C; false where they are none of -40 to 125 deg C.
bool sca100t_temperature(uint8_t *counts);
