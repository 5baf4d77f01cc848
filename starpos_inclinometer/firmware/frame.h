// SPDX-License-Identifier: Apache-2.0
// The protocol's lines (PROTOCOL.md): `$BODY*CCCC` CR LF.
#pragma once

#include <stdbool.h>
#include <stdint.h>

void frame_begin(char kind);
void frame_field(uint32_t value, uint8_t bytes); // a comma, and two hexadecimal digits a byte
bool frame_send(void);                            // false: the line is busy, nothing was sent

enum frame_error { FRAME_GOOD, FRAME_NONE, FRAME_WRONG_CRC };

// Whether the line is `BODY*CCCC`, whose body has 5 bytes less; FRAME_NONE: it is not framed so.
enum frame_error frame_check(const char *line, uint8_t length);
bool frame_parse(const char *digits, uint8_t count, uint16_t *value); // upper-case hexadecimal only
