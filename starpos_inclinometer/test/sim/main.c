// SPDX-License-Identifier: Apache-2.0
// inclinometer-sim: the very firmware on an emulated board, its serial line on a pseudo-terminal.
// What the board feels is told line by line on standard input, see USAGE; each is answered by a line.
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <poll.h>
#include <pty.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "complain.h"
#include "mcu.h"

static const char USAGE[] =
    "usage: inclinometer-sim ELF [--speed FACTOR] [--link PATH] [--board paper|nano] [--unit HEX] [--tilt X Y]\n"
    "Runs until its standard input ends. FACTOR is 1 for real time; at 0 time passes by `run` only. Its lines:\n"
    "  run MS [BYTES] once BYTES bytes altogether have come from the host\n"
    "  tilt X Y [RATE_X RATE_Y]   deg, and deg/s from now on\n"
    "  noise DEG      rms of the sensor within its bandwidth\n"
    "  temperature C\n"
    "  freeze 0|1     1: the converter does not finish what it does\n"
    "  reference 0|1  0: the converter's reference is open\n"
    "  sensor 0|1     0: the sensor does not answer on the SPI bus\n"
    "  shutter AFTER_MS MS [BOUNCES]  its contact closes, and opens again\n"
    "  pps AFTER_MS EVERY_MS          a receiver's pulses; 0 ends them\n"
    "  face 0|1       1: the board lies on its face\n"
    "  miso 0|1       0: the SCL3300's answers do not arrive\n"
    "  noisy 0|1      1: each third answer of the SCL3300 has a wrong bit\n"
    "  fail BITS      the SCL3300's own supervision sets bits of its status\n"
    "  selftest N     the SCL3300's self-test output\n"
    "  supply         the SCL3300 alone loses its supply for a moment\n"
    "  adc            the converter alone is reset, as by a spike\n"
    "  slip BYTES     after so many bytes its interface gets out of step, as by a spike\n"
    "  reset, power   the MCU by its pin; the whole board\n"
    "  hang [BYTES]   the MCU runs into an endless loop; once so many bytes of a write to the converter are to come\n"
    "  state          what the board knows of itself\n";

#define SLICE_S 1e-3
#define MAX_LAG_S 0.5 // more than that the time is not caught up
#define PATIENCE_MS 1000 // with a host that does not read, or whose bytes are awaited

static int master = -1;
static FILE *answers; // standard output; simavr prints what it likes, so its own is elsewhere
static volatile sig_atomic_t stopped;
static unsigned long bytes_sent, bytes_received;

static void stop(int number)
{
    (void)number;
    stopped = 1;
}

static double wall(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec * 1e-9;
}

// With nobody at the other end the master is hung up, and a cable keeps nothing for later.
static bool connected(void)
{
    struct pollfd p = {.fd = master, .events = POLLIN};
    return poll(&p, 1, 0) >= 0 && !(p.revents & POLLHUP);
}

static void sent(char byte)
{
    struct pollfd writable = {.fd = master, .events = POLLOUT};
    if (!connected())
        return;
    if (poll(&writable, 1, PATIENCE_MS) == 1 && write(master, &byte, 1) == 1)
        bytes_sent++;
}

static void take_bytes(void)
{
    char bytes[64];
    ssize_t n = read(master, bytes, sizeof bytes);
    if (n > 0)
        bytes_received += mcu_receive(bytes, n);
}

static bool await_bytes(unsigned long total)
{
    struct pollfd readable = {.fd = master, .events = POLLIN};
    while (bytes_received < total) {
        if (poll(&readable, 1, PATIENCE_MS) != 1)
            return false;
        take_bytes();
    }
    return true;
}

static const char *open_pty(void)
{
    struct termios raw;
    int slave;
    if (openpty(&master, &slave, NULL, NULL, NULL) < 0)
        return NULL;
    tcgetattr(slave, &raw);
    cfmakeraw(&raw);
    tcsetattr(slave, TCSANOW, &raw);
    const char *path = ttyname(slave);
    close(slave);
    fcntl(master, F_SETFL, O_NONBLOCK);
    return path;
}

static void print_state(void)
{
    const struct adc *a = &mcu.adc;
    double now = mcu_now();
    fprintf(answers,
           "{\"ms\": %.3f, \"line_ms\": %.3f, \"awake_ms\": %.3f, \"mode\": %u, \"filter\": %u, \"dac\": %u, "
           "\"calibrated\": %d, \"adc_resets\": %u, \"conversions\": %u, \"frames\": %u, \"sensor_resets\": %u, \"sent\": %lu, \"complaints\": \"%s\"}\n",
           (now - mcu.reset_at) * 1e3, (mcu.line_at - mcu.reset_at) * 1e3, (now - mcu.asleep) * 1e3, a->mode, a->filter,
           a->dac, a->full_scale[0] && a->full_scale[1] && a->zero_scale[0] && a->zero_scale[1], a->resets,
           a->conversions, mcu.scl3300.frames, mcu.scl3300.resets, bytes_sent, complaints());
}

// Whether the command is one, with as many numbers as it takes.
static bool obey(const char *command)
{
    char name[16];
    double v[4] = {0};
    int n = sscanf(command, "%15s %lf %lf %lf %lf", name, v, v + 1, v + 2, v + 3) - 1;
    const double deg = M_PI / 180;
    if (n < 0)
        return false;
    if (!strcmp(name, "tilt") && (n == 2 || n == 4))
        sensor_tilt(&mcu.sensor, mcu_now(), v[0] * deg, v[1] * deg, v[2] * deg, v[3] * deg);
    else if (!strcmp(name, "noise") && n == 1)
        mcu.sensor.noise_rad = v[0] * deg;
    else if (!strcmp(name, "run") && (n == 1 || n == 2))
        return await_bytes(v[1]) && mcu_run(mcu_now() + v[0] * 1e-3);
    else if (!strcmp(name, "temperature") && n == 1)
        mcu.sensor.celsius = v[0];
    else if (!strcmp(name, "freeze") && n == 1)
        mcu.adc.frozen = v[0];
    else if (!strcmp(name, "reference") && n == 1)
        mcu.adc.reference_missing = !v[0];
    else if (!strcmp(name, "sensor") && n == 1)
        mcu.sensor.absent = !v[0];
    else if (!strcmp(name, "shutter") && (n == 2 || n == 3))
        mcu_shutter(v[0] * 1e-3, v[1] * 1e-3, v[2]);
    else if (!strcmp(name, "pps") && n == 2)
        mcu_pps(v[0] * 1e-3, v[1] * 1e-3);
    else if (!strcmp(name, "face") && n == 1)
        mcu.scl3300.upside_down = v[0];
    else if (!strcmp(name, "miso") && n == 1)
        mcu.scl3300.broken = !v[0];
    else if (!strcmp(name, "noisy") && n == 1)
        mcu.scl3300.noisy = v[0];
    else if (!strcmp(name, "fail") && n == 1)
        scl3300_fail(&mcu.scl3300, v[0]);
    else if (!strcmp(name, "selftest") && n == 1)
        mcu.scl3300.self_test = v[0];
    else if (!strcmp(name, "supply") && n == 0)
        scl3300_power_on(&mcu.scl3300, -1); // long ago: the firmware cannot know of it
    else if (!strcmp(name, "adc") && n == 0)
        adc_power_on(&mcu.adc);
    else if (!strcmp(name, "slip") && n == 1)
        mcu.adc.slips_after = v[0];
    else if ((!strcmp(name, "reset") || !strcmp(name, "power")) && n == 0)
        mcu_reset(*name == 'p');
    else if (!strcmp(name, "hang") && n == 0)
        mcu_hang();
    else if (!strcmp(name, "hang") && n == 1)
        mcu.hang_at = v[0];
    else
        return !strcmp(name, "state") && n == 0;
    return true;
}

// Whether standard input goes on.
static bool take_commands(void)
{
    static char text[512];
    static size_t length;
    ssize_t n = read(STDIN_FILENO, text + length, sizeof text - 1 - length);
    if (n <= 0)
        return n < 0 && errno == EINTR;
    length += n;
    text[length] = 0;
    char *end;
    while ((end = strchr(text, '\n'))) {
        *end = 0;
        if (obey(text))
            print_state();
        else
            fprintf(answers, "not a command: %s\n", text);
        length -= end + 1 - text;
        memmove(text, end + 1, length + 1);
    }
    fflush(answers);
    return length < sizeof text - 1;
}

// Until the time that is due by the wall's clock; false: the MCU crashed.
static bool follow_wall(double *began, double speed, bool *late)
{
    double due = (wall() - *began) * speed, now = mcu_now();
    if (due - now > MAX_LAG_S * speed) {
        *began += (due - now) / speed - MAX_LAG_S;
        due = now + MAX_LAG_S * speed;
    }
    bool runs = mcu_run(fmin(due, now + 20 * SLICE_S));
    *late = mcu_now() < due - SLICE_S * speed;
    return runs;
}

static int run(double speed)
{
    double began = wall();
    while (!stopped) {
        bool late = false;
        if (speed && !follow_wall(&began, speed, &late))
            return 1;
        struct pollfd watched[] = {{.fd = STDIN_FILENO, .events = POLLIN},
                                   {.fd = speed && connected() ? master : -1, .events = POLLIN}};
        if (poll(watched, 2, late ? 0 : speed ? SLICE_S * 1e3 : -1) < 0 && errno != EINTR)
            return 1;
        if (watched[0].revents && !take_commands())
            break;
        if (watched[1].revents & POLLIN)
            take_bytes();
    }
    return 0;
}

int main(int argc, char **argv)
{
    const char *elf = NULL, *link = NULL;
    double speed = 1, x = 0, y = 0;
    uint32_t unit = UINT32_MAX;
    enum board board = PAPER;
    for (int i = 1; i < argc; i++) {
        int left = argc - 1 - i;
        if (!strcmp(argv[i], "--speed") && left >= 1)
            speed = atof(argv[++i]);
        else if (!strcmp(argv[i], "--link") && left >= 1)
            link = argv[++i];
        else if (!strcmp(argv[i], "--board") && left >= 1)
            board = strcmp(argv[++i], "nano") ? PAPER : NANO;
        else if (!strcmp(argv[i], "--unit") && left >= 1)
            unit = strtoul(argv[++i], NULL, 16);
        else if (!strcmp(argv[i], "--tilt") && left >= 2)
            x = atof(argv[++i]), y = atof(argv[++i]);
        else if (*argv[i] != '-' && !elf)
            elf = argv[i];
        else
            elf = NULL, i = argc;
    }
    if (!elf || !(speed >= 0)) {
        fputs(USAGE, stderr);
        return 2;
    }
    struct sigaction action = {.sa_handler = stop};
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    const char *path = open_pty();
    if (!path || (link && symlink(path, link) < 0)) {
        fprintf(stderr, "inclinometer-sim: %s: %s\n", link && path ? link : "pseudo-terminal", strerror(errno));
        return 1;
    }
    answers = fdopen(dup(STDOUT_FILENO), "w");
    if (!answers || !freopen("/dev/null", "w", stdout))
        return 1;
    mcu.sent = sent;
    int status = 1;
    if (mcu_init(elf, board, unit)) {
        sensor_tilt(&mcu.sensor, 0, x * M_PI / 180, y * M_PI / 180, 0, 0);
        fprintf(answers, "%s\n", link ? link : path);
        fflush(answers);
        status = run(speed);
        if (status)
            fprintf(stderr, "inclinometer-sim: the MCU crashed\n");
    } else {
        fprintf(stderr, "inclinometer-sim: %s: not a firmware for this board\n", elf);
    }
    if (link)
        unlink(link);
    return status;
}
