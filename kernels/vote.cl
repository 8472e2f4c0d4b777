/* placeholder so that the family builds; replaced below */
#include "common.h"
