/* What a status means, in words. */
#include "ast.h"

const char *ast_status_text(ast_status status) {
  switch (status) {
    case AST_OK:
      return "all is well";
    case AST_NO_MEMORY:
      return "scratch memory could not be had";
    case AST_NOT_FINITE:
      return "a position is NaN or infinite";
    case AST_OUTSIDE:
      return "a position lies outside the cube, or a scene is 2^21 or more wide";
    case AST_TOO_LARGE:
      return "there are more cells than an int32 can number";
  }
  return "the status is unknown";
}
