/* Of each event with a condition a number, positive or zero where it is true. */
void PREFIX_guards(const PREFIX_parameters *p, double t, const double *x, const double *u, double *values);

/* The priority of each event: those at given times, then those with a condition. */
void PREFIX_ranks(const PREFIX_parameters *p, double t, const double *x, const double *u, double *values);

/* Of each event at given times the first one (NaN: the start), the interval (0: once) and the last time. */
void PREFIX_timing(const PREFIX_parameters *p, double *values);

/* The states after an event. */
void PREFIX_happen(const PREFIX_parameters *p, double t, const double *x, const double *u, int event, double *found);

