"""In which ways may a machine depart from a linear, steady response, and does a fit show it?"""
