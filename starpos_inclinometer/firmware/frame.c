// SPDX-License-Identifier: Apache-2.0
#include "frame.h"

#include <util/crc16.h>

#include "uart.h"

#define MAX_LINE 48
#define TAIL 5 // '*' and the CRC's digits

static char line[MAX_LINE];
static uint8_t length;

static char digit(uint8_t nibble)
{
    return nibble < 10 ? '0' + nibble : 'A' - 10 + nibble;
}

static void put_bytes(uint32_t value, uint8_t bytes)
{
    for (uint8_t i = length + 2 * bytes; i > length; value >>= 8) {
        line[--i] = digit(value & 0xF);
        line[--i] = digit((uint8_t)value >> 4);
    }
    length += 2 * bytes;
}

static uint16_t crc(const char *body, uint8_t count)
{
    uint16_t sum = 0;
    while (count--)
        sum = _crc_xmodem_update(sum, *body++);
    return sum;
}

void frame_begin(char kind)
{
    line[0] = '$';
    line[1] = kind;
    length = 2;
}

void frame_field(uint32_t value, uint8_t bytes)
{
    line[length++] = ',';
    put_bytes(value, bytes);
}

bool frame_send(void)
{
    uint16_t sum = crc(line + 1, length - 1);
    line[length++] = '*';
    put_bytes(sum, 2);
    line[length++] = '\r';
    line[length++] = '\n';
    return uart_send(line, length);
}

bool frame_parse(const char *digits, uint8_t count, uint16_t *value)
{
    uint16_t sum = 0;
    while (count--) {
        char c = *digits++;
        if (c >= '0' && c <= '9')
            sum = sum << 4 | (c - '0');
        else if (c >= 'A' && c <= 'F')
            sum = sum << 4 | (c - 'A' + 10);
        else
            return false;
    }
    *value = sum;
    return true;
}

enum frame_error frame_check(const char *text, uint8_t count)
{
    uint16_t sum;
    if (count <= TAIL || !frame_parse(text + count - TAIL + 1, TAIL - 1, &sum))
        return FRAME_NONE;
    uint8_t body = count - TAIL;
    for (uint8_t i = 0; i <= body; i++) {
        if (text[i] == '\r' || text[i] == '\n' || (text[i] == '*') != (i == body))
            return FRAME_NONE;
    }
    return crc(text, body) == sum ? FRAME_GOOD : FRAME_WRONG_CRC;
}
