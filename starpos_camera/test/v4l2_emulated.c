// SPDX-License-Identifier: Apache-2.0
// A camera of V4L2 for programs that this library is preloaded into: OpenCV's own backend talks to it as to the kernel's.
// It is /dev/starpos-emulated while the file `plugged` is in the folder STARPOS_V4L2; other files there change what it
// does: `short` (frames lack 16 bytes), `unstamped`, `realtime` (stamps of the other clock), `frozen`, `automatic` (no
// control of the exposure), `dark` (exposed for longer than the period that it tells), `pull` (`plugged` goes as soon as
// a frame is waited for). A frame is exposed up to its stamp, and there 10 ms later. Its pixels are row * 5 + column * 3,
// but for the first 8: the start of the exposure, steady time in us.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

enum { BUFFERS = 8, PERIOD_US = 40000, TRANSFER_US = 10000, ROOM = 1 << 20 };
static const char *const NAME = "/dev/starpos-emulated";
static const uint32_t FORMATS[] = {V4L2_PIX_FMT_YUYV, V4L2_PIX_FMT_GREY, V4L2_PIX_FMT_Y16, V4L2_PIX_FMT_SRGGB8};

static int device = -1, streaming, count, queue[BUFFERS], queued, done[BUFFERS], ready;
static unsigned char *memory[BUFFERS];
static struct v4l2_buffer about[BUFFERS];
static struct v4l2_pix_format format = {.width = 64, .height = 48, .pixelformat = V4L2_PIX_FMT_YUYV};
static int64_t next_us;  // the start of the next exposure
static int exposure = 50, automatic = 3, gain = 10;  // 100 us, V4L2_EXPOSURE_APERTURE_PRIORITY

static const char *file(const char *name) {
  static char path[4096];
  snprintf(path, sizeof path, "%s/%s", getenv("STARPOS_V4L2"), name);
  return path;
}

static int is(const char *name) { return !access(file(name), F_OK); }

static int64_t clock_us(clockid_t id) {
  struct timespec t;
  clock_gettime(id, &t);
  return t.tv_sec * 1000000LL + t.tv_nsec / 1000;
}

static int each(void) { return format.pixelformat == V4L2_PIX_FMT_YUYV || format.pixelformat == V4L2_PIX_FMT_Y16 ? 2 : 1; }
static int size(void) { return format.width * format.height * each(); }
static int64_t exposed_us(void) { return is("dark") ? 120000 : exposure * 100LL; }
static int64_t there_us(void) { return next_us + exposed_us() + TRANSFER_US; }

static void expose(int index) {
  unsigned char *pixel = memory[index];
  for (unsigned row = 0; row < format.height; row++)
    for (unsigned column = 0; column < format.width; column++, pixel += each()) *pixel = row * 5 + column * 3;
  for (int k = 0; k < 8; k++) memory[index][k * each()] = next_us >> 8 * k;
  int64_t stamp_us = next_us + exposed_us();
  if (is("realtime")) stamp_us += clock_us(CLOCK_REALTIME) - clock_us(CLOCK_MONOTONIC);
  if (is("unstamped")) stamp_us = 0;
  about[index].timestamp.tv_sec = stamp_us / 1000000;
  about[index].timestamp.tv_usec = stamp_us % 1000000;
  about[index].bytesused = size() - (is("short") ? 16 : 0);
}

// What has happened until now: a frame for which no buffer was queued is lost.
static void advance(void) {
  while (streaming && !is("frozen") && there_us() <= clock_us(CLOCK_MONOTONIC)) {
    if (queued) {
      expose(queue[0]);
      done[ready++] = queue[0];
      memmove(queue, queue + 1, --queued * sizeof *queue);
    }
    next_us += exposed_us() > PERIOD_US ? exposed_us() : PERIOD_US;
  }
}

// Called by the program that plays: returns once no buffer is left for a new frame, all have old ones.
void starpos_emulated_fill(void) {
  for (advance(); streaming && queued && !is("frozen"); advance()) {
    struct timespec at = {.tv_sec = there_us() / 1000000, .tv_nsec = there_us() % 1000000 * 1000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
  }
}

static int fail(int error) {
  errno = error;
  return -1;
}

static int wait_for_the_next(void) {
  struct itimerspec at = {.it_value = {.tv_sec = there_us() / 1000000, .tv_nsec = there_us() % 1000000 * 1000}};
  if (is("frozen")) at.it_value.tv_sec += 1000;
  if (is("pull")) unlink(file("plugged"));
  timerfd_settime(device, TFD_TIMER_ABSTIME, &at, NULL);
  return fail(EAGAIN);
}

static int *control(uint32_t id) {
  if (id == V4L2_CID_EXPOSURE_ABSOLUTE && !is("automatic")) return &exposure;
  if (id == V4L2_CID_EXPOSURE_AUTO && !is("automatic")) return &automatic;
  return id == V4L2_CID_GAIN ? &gain : NULL;
}

static int answer(unsigned long request, void *argument) {
  if (!is("plugged")) return fail(ENODEV);
  advance();
  switch (request) {
    case VIDIOC_QUERYCAP: {
      struct v4l2_capability *is_able = argument;
      is_able->capabilities = is_able->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
      return 0;
    }
    case VIDIOC_G_FMT:
    case VIDIOC_S_FMT: {
      struct v4l2_format *wanted = argument;
      if (wanted->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) return fail(EINVAL);
      for (unsigned k = 0; request == VIDIOC_S_FMT && k < sizeof FORMATS / sizeof *FORMATS; k++)
        if (wanted->fmt.pix.pixelformat == FORMATS[k]) format.pixelformat = FORMATS[k];
      if (request == VIDIOC_S_FMT) {
        format.width = wanted->fmt.pix.width >= 128 ? 128 : 64;
        format.height = wanted->fmt.pix.width >= 128 ? 96 : 48;
      }
      format.bytesperline = format.width * each();
      format.sizeimage = size();
      wanted->fmt.pix = format;
      return 0;
    }
    case VIDIOC_G_PARM:
    case VIDIOC_S_PARM: {
      struct v4l2_streamparm *rate = argument;
      rate->parm.capture.timeperframe = (struct v4l2_fract){PERIOD_US, 1000000};
      return 0;
    }
    case VIDIOC_REQBUFS: {
      struct v4l2_requestbuffers *wanted = argument;
      count = wanted->count = wanted->count < BUFFERS ? wanted->count : BUFFERS;
      queued = ready = streaming = 0;
      return 0;
    }
    case VIDIOC_QUERYBUF:
    case VIDIOC_QBUF:
    case VIDIOC_DQBUF: {
      struct v4l2_buffer *buffer = argument;
      if (request == VIDIOC_DQBUF) {
        if (!ready) return wait_for_the_next();
        buffer->index = done[0];
        memmove(done, done + 1, --ready * sizeof *done);
      }
      if ((int)buffer->index >= count) return fail(EINVAL);
      if (request == VIDIOC_QBUF) {
        queue[queued++] = buffer->index;
        return 0;
      }
      buffer->length = ROOM;
      buffer->m.offset = buffer->index * ROOM;
      buffer->bytesused = about[buffer->index].bytesused;
      buffer->timestamp = about[buffer->index].timestamp;
      return 0;
    }
    case VIDIOC_STREAMON:
      streaming = 1;
      next_us = clock_us(CLOCK_MONOTONIC);
      return 0;
    case VIDIOC_STREAMOFF:
      streaming = queued = ready = 0;
      return 0;
    case VIDIOC_QUERYCTRL: {
      struct v4l2_queryctrl *about_it = argument;
      if (!control(about_it->id)) return fail(EINVAL);
      about_it->minimum = 0;
      about_it->maximum = 1000;
      return 0;
    }
    case VIDIOC_G_CTRL:
    case VIDIOC_S_CTRL: {
      struct v4l2_control *wanted = argument;
      int *value = control(wanted->id);
      if (!value) return fail(EINVAL);
      if (request == VIDIOC_S_CTRL) *value = wanted->value > 1000 ? 1000 : wanted->value;
      wanted->value = *value;
      return 0;
    }
  }
  return fail(ENOTTY);
}

static int open_it(void) {
  if (!is("plugged")) return fail(ENOENT);
  if (device >= 0) return fail(EBUSY);
  return device = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK);
}

// Looked up before anything runs: later, a thread that a library starts while it is loaded would wait for the loader.
#define REAL(name) real_##name
#define DECLARE(name) static __typeof__(&name) REAL(name)
DECLARE(open);
DECLARE(open64);
DECLARE(ioctl);
DECLARE(mmap);
DECLARE(mmap64);
DECLARE(munmap);
DECLARE(close);

__attribute__((constructor)) static void look_up(void) {
#define LOOK_UP(name) REAL(name) = (__typeof__(&name))dlsym(RTLD_NEXT, #name)
  LOOK_UP(open);
  LOOK_UP(open64);
  LOOK_UP(ioctl);
  LOOK_UP(mmap);
  LOOK_UP(mmap64);
  LOOK_UP(munmap);
  LOOK_UP(close);
}

int open(const char *path, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  mode_t mode = va_arg(rest, mode_t);
  va_end(rest);
  return strcmp(path, NAME) ? REAL(open)(path, flags, mode) : open_it();
}

int open64(const char *path, int flags, ...) {
  va_list rest;
  va_start(rest, flags);
  mode_t mode = va_arg(rest, mode_t);
  va_end(rest);
  return strcmp(path, NAME) ? REAL(open64)(path, flags, mode) : open_it();
}

int ioctl(int handle, unsigned long request, ...) {
  va_list rest;
  va_start(rest, request);
  void *argument = va_arg(rest, void *);
  va_end(rest);
  return device >= 0 && handle == device ? answer((uint32_t)request, argument) : REAL(ioctl)(handle, request, argument);
}

static void *map(int64_t offset) {
  unsigned char **place = &memory[offset / ROOM];
  if (!*place) *place = calloc(1, ROOM);
  return *place;
}

static int ours(void *start) {
  for (int k = 0; start && k < BUFFERS; k++)
    if (start == memory[k]) return 1;
  return 0;
}

void *mmap(void *start, size_t length, int protection, int flags, int handle, off_t offset) {
  return device >= 0 && handle == device ? map(offset) : REAL(mmap)(start, length, protection, flags, handle, offset);
}

void *mmap64(void *start, size_t length, int protection, int flags, int handle, off64_t offset) {
  return device >= 0 && handle == device ? map(offset) : REAL(mmap64)(start, length, protection, flags, handle, offset);
}

int munmap(void *start, size_t length) { return ours(start) ? 0 : REAL(munmap)(start, length); }

int close(int handle) {
  if (device >= 0 && handle == device) {
    device = -1;
    streaming = queued = ready = 0;
    exposure = 50, automatic = 3;
  }
  return REAL(close)(handle);
}
