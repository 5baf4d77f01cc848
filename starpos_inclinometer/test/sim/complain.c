// SPDX-License-Identifier: Apache-2.0
#include "complain.h"

#include <string.h>

static char said[1024];

void complain(const char *what)
{
    if (strstr(said, what) || strlen(said) + strlen(what) + 3 > sizeof said)
        return;
    if (*said)
        strcat(said, "; ");
    strcat(said, what);
}

const char *complaints(void)
{
    return said;
}
