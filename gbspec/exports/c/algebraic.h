/* The algebraic variables, by Newton's method; NaN where there is no solution. */
void PREFIX_algebraic(const PREFIX_parameters *p, double t, const double *x, const double *u, double *values);
void PREFIX_algebraic_along(const PREFIX_parameters *p, double t, const double *x, const double *u,
                            const PREFIX_parameters *dp, double dt, const double *dx, const double *du, double *out);

